"""Simulation of the scenes of an evaluation, in this process or in worker processes.

Nodes of a Ray cluster share no files with the main machine. The configuration, the policies' code
and their files are sent to the nodes; the library, its dependencies and the data folder must be
there already. Library and data are compared with the main machine's before a simulation.
"""

import contextlib
import functools
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from platform import node
from tempfile import TemporaryDirectory
from typing import TypeAlias

from handover_marl.config import TIME_STEP
from handover_marl.datasets import DATA_DIR_VARIABLE
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import ActionRecorder, EpisodeCallback, EpisodePolicy, derive_robot_seed, run_episode
from handover_marl.episode.metrics.fluency import compute_fluency, has_early_grab
from handover_marl.episode.metrics.motion import TraceRecorder
from handover_marl.errors import ActionError, DataFormatError, DataNotFoundError, OptionError, PolicyError
from handover_marl.evaluation.config import REPLAY, EvaluationConfig, require_policy_reference
from handover_marl.evaluation.results import EpisodeResult, EpisodeWriter
from handover_marl.execution.options import describe_machine
from handover_marl.execution.pool import AnyPool
from handover_marl.policies.reference import PolicyBundle

# For a node whose data folder is missing or differs.
_DATA_FOLDER_ADVICE = (
    f"Machines share no files: every node needs the same data folder, at the same path or named by {DATA_DIR_VARIABLE} "
    "in the environment that Ray was started in there."
)


@dataclass(frozen=True)
class SceneTask:
    """Task of a worker: simulate the scene with the number `scene_id`, at the position `index` of the split.

    The `fingerprint` is the hash of the scene's data on the main machine; an empty one is not compared.
    """

    index: int
    scene_id: int
    fingerprint: str = ""


#: Result of an episode, and the content of each writer's file, in the order of the writers.
FinishedEpisode: TypeAlias = tuple[EpisodeResult, tuple[bytes, ...]]


class EpisodeRunner:
    """Simulator of single scenes of an evaluation, in this process.

    Args:
        config: Resolved configuration, see `resolve_config`.
        parallelism: Number and location of all workers as text, stored beside planning times.
        writers: Writers of files for each episode; their recorders observe the episode.

    Attributes:
        receiver: The robot's policy.
        giver: The person's policy, or None to replay the recording.
        episode: Simulation of all scenes, one after the other; it has the final state of the last scene.
    """

    def __init__(self, config: EvaluationConfig, parallelism: str = "", writers: Sequence[EpisodeWriter] = ()) -> None:
        self.config, self._machine = config, f"{describe_machine()}, {parallelism}"
        self.dataset = config.open_dataset()
        giver, receiver = require_policy_reference(config.giver), require_policy_reference(config.receiver)
        arguments = self.dataset, config.world_config, config.setup
        self.receiver = receiver.make(*arguments)
        self.giver = None if giver.name == REPLAY else giver.make(*arguments)
        self.episode = Episode(config.physics, config.world_config, sensors=config.sensors)
        self._trace_recorder, self._action_recorder = TraceRecorder(), ActionRecorder()
        self._recorders = [writer.create_recorder(config, self.receiver) for writer in writers]

    def run(self, task: SceneTask, receiver: EpisodePolicy | None = None) -> FinishedEpisode:
        """Simulate a scene to the end of its episode; return the result and the content of each writer's file.

        If `receiver` is given, it acts in place of the configured receiver.
        """
        scene = self.dataset.load_scene(task.scene_id)
        fingerprint = self.dataset.compute_fingerprint(task.scene_id)
        if task.fingerprint not in ("", fingerprint):
            raise DataFormatError(
                f"scene {task.scene_id} on {node()} differs from the requested one (fingerprint {fingerprint} there, "
                f"{task.fingerprint} here). {_DATA_FOLDER_ADVICE}"
            )
        self.episode.reset(scene, derive_robot_seed(self.config.seed, scene))
        recorders = [recorder for recorder, _ in self._recorders]
        callbacks: list[EpisodeCallback] = [self._trace_recorder, self._action_recorder, *recorders]
        config, policies = self.config, (receiver or self.receiver, self.giver)
        passed = config.inference_time
        try:
            n_late = run_episode(self.episode, *policies, seed=config.seed, callbacks=callbacks, inference_time=passed)
        except (ActionError, OptionError, PolicyError) as error:
            giver = "" if self.giver is None else f" and giver {self.giver.name!r}"
            raise type(error)(f"receiver {self.receiver.name!r}{giver} in scene {task.scene_id}: {error}") from error
        info, trace, has_clock = scene.info, self._trace_recorder.trace, passed is not None
        result = EpisodeResult(
            index=task.index,
            status=self.episode.status,
            steps=self.episode.steps,
            plan_s=float(self._action_recorder.times.sum()),
            scene_id=task.scene_id,
            release_step=self.episode.release_step,
            object_name=info.target_name,
            subject=info.subject,
            side=info.side,
            n_objects=len(info.object_ids),
            models=self.dataset.describe_models(task.scene_id) or None,
            fingerprint=fingerprint,
            machine=self._machine,
            fluency=compute_fluency(trace),
            late_s=round(n_late * TIME_STEP, 3) if has_clock else None,
            early_grab=has_early_grab(trace) if has_clock else None,
        )
        return result, tuple(encode(result, trace) for _, encode in self._recorders)

    def close(self) -> None:
        """Close the simulation."""
        self.episode.close()


def run_episodes(
    config: EvaluationConfig, tasks: Sequence[SceneTask], pool: AnyPool, writers: tuple[EpisodeWriter, ...] = ()
) -> Generator[tuple[int, FinishedEpisode], None, None]:
    """Simulate scenes of a resolved configuration in workers; yield each episode as soon as it is finished.

    Returns:
        Generator of pairs (index in `tasks`, finished episode); closing it ends the tasks that still run.
    """
    # Without tasks there is no need to connect to a cluster.
    n_workers = min(pool.n_workers, len(tasks)) if tasks else 0
    parallelism = " ".join(filter(None, (f"{n_workers} at a time", pool.location)))
    remote = None
    if pool.is_remote:
        references = map(require_policy_reference, (config.giver, config.receiver))
        folders = (config.data_dir, os.environ.get(DATA_DIR_VARIABLE))
        given, usual = (str(Path(folder).expanduser().resolve()) if folder else "" for folder in folders)
        remote = given, usual, [*map(PolicyBundle.pack, references)]
    open_runner = functools.partial(_open_runner, config, parallelism, writers, remote)
    return pool.map_unordered(open_runner, tasks, lambda task: f"simulating scene {task.scene_id}")


@contextlib.contextmanager
def _open_runner(
    config: EvaluationConfig,
    parallelism: str,
    writers: tuple[EpisodeWriter, ...],
    remote: tuple[str, str, list[PolicyBundle]] | None,
) -> Iterator[Callable[[SceneTask], FinishedEpisode]]:
    """Yield the function that simulates a scene, and close the simulation afterwards.

    For nodes of a cluster, `remote` has the configuration's data folder and the folder of HANDOVER_MARL_DATA on the
    main machine ("" for none), and the policies with their files. A node uses the first folder if it exists there, else
    the folder of its own HANDOVER_MARL_DATA, else the second folder.
    """
    with contextlib.nullcontext("") if remote is None else TemporaryDirectory() as folder:
        if remote is not None:
            given, usual, bundles = remote
            policies = {bundle.reference.agent: bundle.unpack(Path(folder)) for bundle in bundles}
            os.environ[DATA_DIR_VARIABLE] = os.environ.get(DATA_DIR_VARIABLE) or usual
            data_dir = given if given and Path(given).is_dir() else None
            config = replace(config, data_dir=data_dir, **policies)  # type: ignore[arg-type]
            try:
                config.open_dataset()
            except DataNotFoundError as error:
                raise DataNotFoundError(f"on node {node()}: {error} {_DATA_FOLDER_ADVICE}") from error
        with contextlib.closing(EpisodeRunner(config, parallelism, writers)) as runner:
            yield runner.run
