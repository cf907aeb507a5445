"""Profile the planner: time, share of each package, and memory. The script needs the extra `planning`.

    python experiments/speed/profile_planning.py --data-dir DIR --out planning.md

The script plans every scene of a split in one process on one core, from the observation after the receiver's
waiting time (fast physics). It prints planning times, the share of time in each file of the planner
and the peak memory of the process. Each scene is planned twice: the first time includes loading the
object's signed distance field, or computing it if it is not in the cache yet.
"""

import cProfile
import os
import pstats
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np  # noqa: E402  (threads are counted when it is loaded)
import tyro  # noqa: E402
from measuring import OutputArgs, describe_conditions, read_memory  # noqa: E402
from rich.progress import track  # noqa: E402

from handover_marl import receivers  # noqa: E402
from handover_marl.episode.episode import Episode  # noqa: E402
from handover_marl.episode.observations import Observation  # noqa: E402
from handover_marl.evaluation.reports.tables import format_table  # noqa: E402
from handover_marl.learning.training.scene_arguments import SetupArgs  # noqa: E402
from handover_marl.receivers.omg import OmgReceiver  # noqa: E402


@dataclass(frozen=True)
class Args(SetupArgs, OutputArgs):
    """Options of the profile of the planner.

    Attributes:
        receiver: Name of a planning receiver: omg, omg_hand_aware or omg_unchecked_last.
        split: Split of the setup: train, val or test.
        scenes: Number of scenes, evenly chosen from the split; default: all.
    """

    receiver: str = "omg"
    split: str = "test"
    scenes: int | None = None


def observe_after_wait(episode: Episode, receiver: OmgReceiver) -> Observation:
    """Return the observation at the end of the receiver's waiting time, at which it plans."""
    wait = receiver.timing.wait_ms
    episode.advance(receiver.act(episode.observe()), wait)
    return episode.observe()


def measure_planning_time(receiver: OmgReceiver, observation: Observation) -> float:
    receiver.reset()
    start = time.perf_counter()
    receiver.act(observation)
    return time.perf_counter() - start


def compute_time_shares(profile: cProfile.Profile) -> list[list[str]]:
    """Return table rows of the planner's files and their shares (%) of the time.

    The time of a call of another library counts for the file that makes the call.
    """
    spent: dict[str, float] = defaultdict(float)
    statistics = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    for (file, _, _), (_, _, own, _, callers) in statistics.items():
        if is_library_file(file):
            spent[Path(file).name] += own
            continue
        for (caller, _, _), (_, _, _, cumulative) in callers.items():
            if is_library_file(caller):
                spent[Path(caller).name] += cumulative
    total = sum(spent.values())
    rows = sorted(spent.items(), key=lambda item: -item[1])
    return [[name, f"{100 * seconds / total:.1f}"] for name, seconds in rows if seconds > 0.005 * total]


def is_library_file(file: str) -> bool:
    return "handover_marl" in file or Path(file).name == "omg.py"


def format_quantiles(name: str, values: Sequence[float], digits: int) -> list[str]:
    return [name, *(f"{value:.{digits}f}" for value in np.quantile(values, [0.05, 0.5, 0.95, 1.0]))]


def main(args: Args) -> None:
    args = args.resolve_setup()
    data = args.open_dataset()
    ids = data.list_scenes(args.setup, args.split)
    chosen = ids if args.scenes is None else [ids[k] for k in np.linspace(0, len(ids) - 1, args.scenes).astype(int)]
    receiver = receivers.make(args.receiver, data)
    if not isinstance(receiver, OmgReceiver):
        raise SystemExit(f"{args.receiver} does not plan")
    receiver.reset()
    before = read_memory("VmHWM:")
    first, again, steps, goals = [], [], [], []
    profile = cProfile.Profile()
    for scene in track(chosen, "planning"):
        episode = Episode("fast")
        episode.reset(data.load_scene(scene))
        receiver.reset()
        observation = observe_after_wait(episode, receiver)
        episode.close()
        first.append(measure_planning_time(receiver, observation))
        again.append(measure_planning_time(receiver, observation))
        if receiver.plan is not None:
            steps.append(receiver.plan.steps)
            goals.append(len(receiver.plan.goals))
        receiver.reset()
        profile.runcall(receiver.act, observation)
    peak = read_memory("VmHWM:")
    times = [
        format_quantiles("first time, s", first, 3),
        format_quantiles("again, s", again, 3),
        format_quantiles("goals", goals, 0),
        format_quantiles("optimisation steps", steps, 0),
    ]
    args.publish(
        "Planning",
        f"Planning of {args.receiver}: {len(first)} scenes of {args.setup} {args.split}, {data.name}, "
        f"one core, {describe_conditions()}.",
        format_table(["", "5 %", "median", "95 %", "most"], times),
        f"No goal in {len(first) - len(goals)} scenes. Peak memory {peak:.0f} MB, before the first scene "
        f"{before:.0f} MB.",
        "Share of planning by file, with the NumPy functions it calls (cProfile):",
        format_table(["", "%"], compute_time_shares(profile)),
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
