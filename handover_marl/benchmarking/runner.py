"""Running the official protocol: one episode a scene, the giver replays, physics are exact."""

import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl import receivers
from handover_marl._version import __version__
from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.machine import describe_machine
from handover_marl.benchmarking.progress import BenchmarkProgress
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.results import ResultFolder, RunSettings
from handover_marl.benchmarking.writing import write_report
from handover_marl.config import PhysicsConfig, ProtocolConfig
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.datasets.splits import check_setup_and_split
from handover_marl.episode import Episode
from handover_marl.errors import OptionError, SceneError
from handover_marl.receivers import Receiver
from handover_marl.scene import Scene
from handover_marl.spaces import check_receiver_action

GIVER = "replay"
PHYSICS = "exact"


def benchmark(
    setup: str = "s0",
    split: str = "test",
    receiver: str = "yang2021",
    *,
    scenes: Sequence[int] | None = None,
    data_dir: str | os.PathLike[str] | None = None,
    dataset: str = "auto",
    out: str | os.PathLike[str] | None = None,
    progress: bool = True,
) -> Report:
    """Run HandoverSim's official protocol and report its metrics.

    Args:
        setup: Official setup, "s0" to "s3".
        split: "train", "val" or "test".
        receiver: Name of a registered receiver.
        scenes: Only these scenes of the split; the report then says that it is partial.
        data_dir: Folder in HandoverSim's layout; default: the environment variable HANDOVER_MARL_DATA.
        dataset: "dexycb", "synthetic", or "auto": DexYCB when there is a data folder, else synthetic.
        out: Folder for official result files, `report.json` and `report.md`. Scenes that are finished there are
            not run again, so that an interrupted run goes on where it was.
        progress: Whether to show a progress bar and a row for every scene, on stderr.

    Raises:
        UnknownNameError: No such setup, split, dataset or receiver.
        SceneError: A scene is not in the split.
        DataNotFoundError, DataFormatError: Files are missing (noticed before the start) or damaged.
        ResultsError: `out` holds another run or cannot be written.
        ActionError: The receiver returned something that is no action.
    """
    check_setup_and_split(setup, split)
    data = open_dataset(dataset, data_dir)
    split_ids = data.split(setup, split)
    chosen = _choose_scenes(split_ids, scenes, f"{setup} {split}")
    policy = receivers.make(receiver, data)
    data.check_scenes(chosen)
    settings = RunSettings(
        setup=setup,
        split=split,
        receiver=receiver,
        giver=GIVER,
        physics=PHYSICS,
        dataset=data.name,
        version=__version__,
    )
    folder = None if out is None else ResultFolder(Path(out).expanduser(), settings)
    episode = Episode(PHYSICS)
    results = []
    try:
        with BenchmarkProgress(len(chosen), shown=progress) as bar:
            for scene_id in chosen:
                index = split_ids.index(scene_id)
                result = None if folder is None else folder.finished(index, data.fingerprint(scene_id))
                known = result is not None
                if result is None:
                    result = _run_scene(episode, data, policy, index, scene_id, folder)
                results.append(result)
                bar.add(result, known)
    finally:
        episode.close()
    report = Report(settings, tuple(results), len(split_ids))
    if folder is not None:
        write_report(folder.path, report)
    return report


def play(
    episode: Episode, scene: Scene, policy: Receiver
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """Play a scene to its end.

    Returns:
        (T, 9) the action of every physics step, and (T,) the policy's wall-clock time at every step (s), zero
        where it was not asked because its last action stood.
    """
    horizon = ProtocolConfig().horizon_steps
    actions, times = np.zeros((horizon, 9), dtype=np.float32), np.zeros(horizon)
    episode.reset(scene)
    policy.reset(seed=scene.info.scene_id)
    while not episode.status:
        observation = episode.observe()
        started = time.perf_counter()
        action = policy.act(observation)
        times[episode.steps] = time.perf_counter() - started
        before = episode.steps
        actions_now = check_receiver_action(action)
        episode.advance(actions_now, _hold_steps(policy, horizon))
        actions[before : episode.steps] = actions_now
    return actions[: episode.steps], times[: episode.steps]


def _run_scene(
    episode: Episode,
    dataset: Dataset,
    policy: Receiver,
    index: int,
    scene_id: int,
    folder: ResultFolder | None,
) -> EpisodeResult:
    actions, times = play(episode, dataset.scene(scene_id), policy)
    info = episode.scene.info
    result = EpisodeResult(
        index=index,
        status=episode.status,
        steps=episode.steps,
        plan_time=float(times.sum()),
        scene_id=scene_id,
        release_step=episode.release_step,
        object_name=info.target_name,
        subject=info.subject,
        side=info.side,
        n_objects=len(info.object_ids),
        fingerprint=dataset.fingerprint(scene_id),
        machine=describe_machine(),
    )
    if folder is not None:
        folder.save(result, actions, times)
    return result


def _hold_steps(policy: Receiver, horizon: int) -> int:
    hold_time = policy.hold_time
    if not hold_time > 0.0:
        raise OptionError(f"receiver {policy.name!r}: hold_time is {hold_time}; it must be positive (s)")
    return max(1, round(min(hold_time / PhysicsConfig().time_step, horizon)))


def _choose_scenes(split_ids: tuple[int, ...], scenes: Sequence[int] | None, where: str) -> tuple[int, ...]:
    if scenes is None:
        return split_ids
    foreign = [scene for scene in scenes if scene not in split_ids]
    if foreign:
        raise SceneError(
            f"scene {foreign[0]} is not in {where}, which has {len(split_ids)} scenes from {split_ids[0]} to "
            f"{split_ids[-1]}; choose scenes of this split or another --setup or --split"
        )
    if not scenes:
        raise SceneError(f"no scene chosen; leave scenes out to run all {len(split_ids)} of {where}")
    return tuple(sorted(set(scenes)))
