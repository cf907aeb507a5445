"""Compare outcomes of episodes in MuJoCo Warp and in MuJoCo on the same scenes.

    python -m experiments.measure_warp_agreement --scenes 40 --out agreement.md

All episodes are simulated together, first by MuJoCo, then by MuJoCo Warp. The giver replays the recordings. On Warp's
CPU device, 40 whole episodes take about half an hour. Episodes that run at the horizon in both are not counted.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro

from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.vector.array_episodes import ArrayEpisodes
from handover_marl.envs.wrappers.freeze import freeze
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.tables import NO_VALUE, format_percent_rate, format_table
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import describe_machine
from handover_marl.geometry.arrays import to_numpy
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.policies.policy import make_giver_action
from handover_marl.simulation.engines import CPU, THREADS, WARP, BatchBackend

Counts = npt.NDArray[np.int_]


@dataclass(frozen=True)
class Args(SetupArgs):
    """Options of the comparison of MuJoCo Warp with MuJoCo.

    Attributes:
        receiver: Receiver, by name or policy file.
        split: Split of the setup: train or val; the test split is for final results.
        scenes: Number of scenes, evenly spaced over the split.
        device: Device of MuJoCo Warp: cuda, or cpu.
        horizon: Number of physics steps after which an episode is not simulated further; at most 13,000.
        control_period: Time for which actions hold (s).
        trust: Whether a policy file may run code.
        out: Markdown file to write; default: the report is only printed.
    """

    receiver: str = "yang2021"
    split: str = "train"
    scenes: int = 40
    device: str = CPU
    horizon: int = 13_000
    control_period: float = 0.05
    trust: bool = False
    out: Path | None = None


@dataclass(frozen=True)
class Outcomes:
    """Outcomes of n episodes.

    Attributes:
        status: Status bits (n,); 0 for running episodes.
        steps: Numbers (n,) of physics steps.
        released: Physics steps (n,) of the releases; -1 without one.
        seconds: Duration of the simulation (s).
    """

    status: Counts
    steps: Counts
    released: Counts
    seconds: float


def simulate(args: Args, scenes: Sequence[int], backend: BatchBackend) -> Outcomes:
    """Simulate an episode of each scene together, and report the progress on standard error."""
    config = EnvConfig(
        setup=args.setup,
        split=args.split,
        dataset=args.dataset,
        data_dir=args.data_dir,
        physics="mujoco",
        control_period=args.control_period,
    )
    template = freeze(HandoverEnv(config), "giver", args.receiver, trust=args.trust)
    episodes = ArrayEpisodes(template, len(scenes), args.receiver, args.trust, backend)
    dataset = template.unwrapped.dataset
    started, rows, arrays = time.perf_counter(), np.arange(len(scenes)), episodes.arrays
    for row, scene in enumerate(scenes):
        episodes.start(row, dataset.load_scene(scene), seed=scene, robot_seed=scene, camera_seed=scene)
    periods = -(-args.horizon // config.control_steps)
    for period in range(periods):
        running = rows[~to_numpy(episodes.have_ended(arrays.asarray(rows)))]
        if not len(running):
            break
        actions = np.tile(make_giver_action(), (len(running), 1))
        episodes.advance(arrays.asarray(running), {"giver": arrays.asarray(actions)})
        if period % 20 == 0:
            print(f"{backend.name}: {period} of {periods} periods, {len(running)} running", file=sys.stderr, flush=True)
    seconds = time.perf_counter() - started
    infos = {key: to_numpy(own) for key, own in episodes.make_result(arrays.asarray(rows)).infos["giver"].items()}
    episodes.close()
    return Outcomes(infos["status"], infos["steps"], infos["release_step"], seconds)


def describe_status(status: int) -> str:
    """Return the names of status bits."""
    return str(EpisodeStatus(status)).removeprefix("EpisodeStatus.")


def main(args: Args) -> None:
    """Simulate the scenes with both backends, and print a report."""
    args = args.resolve_setup()
    dataset = args.open_dataset()
    scenes = select_scenes_evenly(dataset.list_scenes(args.setup, args.split), args.scenes)
    threads = simulate(args, scenes, BatchBackend(THREADS))
    warp = simulate(args, scenes, BatchBackend(WARP, args.device))
    same = threads.status == warp.status
    success = int(EpisodeStatus.SUCCESS)
    differing = [
        (scene, describe_status(one), describe_status(other), steps, warp_steps)
        for scene, one, other, steps, warp_steps in zip(
            scenes, threads.status, warp.status, threads.steps, warp.steps, strict=True
        )
        if one != other
    ]
    released = (threads.released >= 0) & (warp.released >= 0)
    shift = np.abs(threads.released - warp.released)[released]
    ended = (threads.status != 0) | (warp.status != 0)
    n_same, n_ended = int(same[ended].sum()), int(ended.sum())
    rate = format_percent_rate(n_same, n_ended) if n_ended else NO_VALUE
    n_running = [int((one.status == 0).sum()) for one in (threads, warp)]
    n_success = [int((one.status == success).sum()) for one in (threads, warp)]
    median = np.median(shift) if len(shift) else 0.0
    parts = [
        f"{args.receiver}, giver replay, {len(scenes)} scenes of {args.dataset} {args.setup} {args.split}, horizon "
        f"{args.horizon} steps, MuJoCo Warp on {args.device}, {describe_machine()}.",
        f"Same outcome: {n_same} of {n_ended} episodes that ended ({rate} %). "
        f"Success: {n_success[0]} with MuJoCo, {n_success[1]} with MuJoCo Warp. Running at the horizon: "
        f"{n_running[0]} and {n_running[1]}. The object was released in both in {released.sum()} episodes, with a "
        f"median difference of {median:.0f} steps. Duration: {threads.seconds:.0f} s and {warp.seconds:.0f} s.",
        format_table(("scene", "MuJoCo", "MuJoCo Warp", "steps MuJoCo", "steps MuJoCo Warp"), differing),
    ]
    text = "\n\n".join(parts)
    print(text)
    if args.out is not None:
        write_atomically(args.out, f"# Agreement of MuJoCo Warp and MuJoCo\n\n{text}\n")


if __name__ == "__main__":
    main(tyro.cli(Args))
