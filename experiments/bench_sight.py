"""What the wrist camera costs and how far its two renderers agree.

    python experiments/bench_sight.py --data-dir DIR --out sight.md

Views are those of Yang's receiver at moments spread over its episodes, in fast physics. Times are CPU times of one
process. Whole environments take turns within one run, so that the machine's drift cancels.
"""

import multiprocessing
import time
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from handover_marl.benchmarking.machine import describe_machine
from handover_marl.benchmarking.tables import table
from handover_marl.config import OFFICIAL, PANDA_DOF
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.episode.episode import Episode
from handover_marl.episode.play import play
from handover_marl.episode.sight import Sight, SightConfig
from handover_marl.episode.watchers import Watcher
from handover_marl.files import write_atomically
from handover_marl.policies.reference import policy_reference
from handover_marl.sim.camera.photo import Photo, Seen
from handover_marl.sim.rays.ray_camera import RayCamera

SETUPS = ("s0", "s1", "s2", "s3")
SOUGHT = (Seen.TARGET, Seen.HAND)


@dataclass(frozen=True)
class Args:
    """What to measure.

    Attributes:
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic or auto.
        robot: panda or panda_camera.
        scenes: Scenes of the validation splits of all setups to look at.
        views: Views of each.
        receiver: Whose views.
        period: Time between decisions (s).
        steps: Control steps of each environment in a turn.
        turns: Turns of each environment; 0 leaves this out.
        out: Markdown file to write.
    """

    data_dir: str | None = None
    dataset: str = "auto"
    robot: str = "panda_camera"
    scenes: int = 50
    views: int = 4
    receiver: str = "yang2021"
    period: float = 0.15
    steps: int = 20
    turns: int = 10
    out: str | None = None


class Decisions(Watcher):
    """Asks for clouds as often as a receiver that decides every so many steps.

    Attributes:
        times: CPU time (s) of every cloud.
    """

    def __init__(self, period: int) -> None:
        self.times: list[float] = []
        self._period = period
        self._sight = Sight(SightConfig(renderer="rays"), "fast", OFFICIAL.physics)

    def started(self, episode: Episode) -> None:
        """Read the scene's models before anything is timed."""
        self._sight.reset(episode.scene, episode.world)
        self._sight.observe("points", episode.world, 0)

    def stepped(self, episode: Episode) -> None:
        """Look, if it is time to."""
        if episode.steps % self._period == 0:
            started = time.process_time()
            self._sight.observe("points", episode.world, episode.steps)
            self.times.append(time.process_time() - started)


class Views(Watcher):
    """Looks at one episode with both renderers.

    Attributes:
        pairs: Pictures of Bullet and of the ray caster.
        times: CPU time (s) of object and hand alone, of the whole picture, and of Bullet's.
    """

    def __init__(self, moments: list[int], camera: RayCamera) -> None:
        self.pairs: list[tuple[Photo, Photo]] = []
        self.times: list[tuple[float, ...]] = []
        self._moments, self._camera = set(moments), camera

    def stepped(self, episode: Episode) -> None:
        """Look, if it is time to."""
        if episode.steps not in self._moments:
            return
        world, now = episode.world, episode.world.snapshot()
        stamps = [time.process_time()]
        self._camera.sought(now)
        stamps.append(time.process_time())
        rays = self._camera.photograph(now, color=False)
        stamps.append(time.process_time())
        bullet = world.photograph(color=False)
        stamps.append(time.process_time())
        self.pairs.append((bullet, rays))
        self.times.append(tuple(np.diff(stamps).tolist()))


def look(args: Args, data: Dataset) -> tuple[Decisions, Views]:
    """All pictures and times."""
    scenes = list(dict.fromkeys(scene for setup in SETUPS for scene in data.split(setup, "val")))
    chosen = [scenes[int(place)] for place in np.linspace(0, len(scenes) - 1, min(args.scenes, len(scenes)))]
    episode = Episode("fast")
    robot = policy_reference("receiver", args.receiver).make(data)
    decisions, found = (
        Decisions(round(1000 * args.period)),
        Views([], RayCamera(data.scene(0).assets, OFFICIAL.physics)),
    )
    for scene_id in track(chosen, "views", console=Console(stderr=True)):
        scene = data.scene(scene_id)
        episode.reset(scene)
        play(episode, robot, seed=0, watchers=[decisions])
        moments = np.linspace(0, episode.steps, args.views + 1)[1:].astype(int).tolist()
        views = Views(moments, RayCamera(scene.assets, OFFICIAL.physics))
        episode.reset(scene)
        play(episode, robot, seed=0, watchers=[views])
        found.pairs += views.pairs
        found.times += views.times
    episode.close()
    return decisions, found


def agreement_table(pairs: list[tuple[Photo, Photo]]) -> str:
    """How far the two renderers agree, by what is seen."""
    rows = []
    for seen in Seen:
        shown = [(first.shows(seen), second.shows(seen)) for first, second in pairs]
        either = sum(int((one | other).sum()) for one, other in shown)
        both = sum(int((one & other).sum()) for one, other in shown)
        if not either:
            continue
        apart = np.concatenate(
            [
                np.abs(first.depth - second.depth)[one & other]
                for (first, second), (one, other) in zip(pairs, shown, strict=True)
            ]
        )
        near = f"{100.0 * np.mean(apart <= 1e-4):.3f}"
        spread = [f"{value:.1e}" for value in (np.median(apart), np.percentile(apart, 99), apart.max())]
        rows.append([seen.name.lower(), either, f"{100.0 * both / either:.4f}", near, *spread])
    header = ["seen", "pixels", "alike %", "depth within 1e-4 m %", "median m", "99 % m", "most m"]
    return table(header, rows)


def time_table(decisions: Decisions, views: Views) -> str:
    """CPU times of views."""
    sought, whole, bullet = zip(*views.times, strict=True)
    rows = []
    for name, seconds in (
        ("cloud of a decision (rays)", decisions.times),
        ("object and hand (rays)", sought),
        ("whole picture (rays)", whole),
        ("whole picture (bullet)", bullet),
    ):
        middle, most = np.percentile(seconds, [50, 95])
        times = [f"{1000.0 * value:.2f}" for value in (middle, most, np.mean(seconds))]
        rows.append([name, len(seconds), *times])
    return table(["224 x 224", "views", "median ms", "95 % ms", "mean ms"], rows)


def environment(args: Args, physics: str) -> HandoverEnv:
    """One that shows points."""
    common: dict[str, Any] = {
        "data_dir": args.data_dir,
        "dataset": args.dataset,
        "robot": args.robot,
        "split": "val",
    }
    return HandoverEnv(control_period=args.period, sight="points", physics=physics, **common)


def take_turn(env: HandoverEnv, steps: int) -> float:
    """Seconds for so many control steps at the start pose, resets not counted."""
    action = {"giver": np.zeros(8, dtype=np.float32), "receiver": np.zeros(PANDA_DOF, dtype=np.float32)}
    action["receiver"][:] = env.config.physics.panda.start_joints
    seconds = 0.0
    for _ in range(steps):
        if not env.agents:
            env.reset()
        started = time.process_time()
        env.step(action)
        seconds += time.process_time() - started
    return seconds


def peak_memory(args: Args, physics: str) -> float:
    """MiB that a process with one environment takes at most, in a few episodes."""
    env = environment(args, physics)
    for seed in range(3):
        env.reset(seed=seed)
        take_turn(env, args.steps)
    # Not getrusage, whose peak a new process takes over from the one that started it.
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024.0


def environment_table(args: Args) -> str:
    """Whole environments, with what they take of the memory."""
    contestants, rows = {}, []
    for name, physics in (("exact, bullet", "exact"), ("fast, rays", "fast")):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            rows.append([name, f"{pool.apply(peak_memory, (args, physics)):.0f}"])
        contestants[name] = environment(args, physics)
        contestants[name].reset(seed=0)
        take_turn(contestants[name], args.steps)
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in track(range(args.turns), "turns", console=Console(stderr=True)):
        for name, env in contestants.items():
            seconds[name].append(take_turn(env, args.steps))
    ratios = np.array(seconds["exact, bullet"]) / np.array(seconds["fast, rays"])
    for row in rows:
        times = 1000.0 * np.array(seconds[row[0]]) / args.steps
        row.insert(1, f"{np.median(times):.2f}")
    rows[0].append("1")
    rows[1].append(f"{np.median(ratios):.1f} ({ratios.min():.1f} to {ratios.max():.1f})")
    return table([f"points every {args.period} s", "ms a step", "MiB of a process with one", "times as fast"], rows)


def main(args: Args) -> None:
    """Print the tables and write them."""
    data = open_dataset(args.dataset, args.data_dir, args.robot)
    decisions, found = look(args, data)
    name = {"dexycb": "DexYCB", "synthetic": "synthetic scenes"}[data.name]
    parts = [
        f"{len(found.pairs)} views of {args.scenes} scenes of the validation splits, {name}, {args.robot}, receiver "
        f"{args.receiver}, fast physics. {describe_machine()}, {date.today()}.",
        agreement_table(found.pairs),
        time_table(decisions, found),
    ]
    if args.turns:
        parts.append(environment_table(args))
    text = "\n\n".join(parts)
    print(text)
    if args.out is not None:
        write_atomically(Path(args.out), f"# The wrist camera\n\n{text}\n")


if __name__ == "__main__":
    main(tyro.cli(Args))
