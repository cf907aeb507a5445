"""Training GA-DDPG's network by imitation: plans, rounds of states and updates, and what is kept.

A run is a folder: `plans/` and `states/` are made once, `checkpoint.pt` is what `--resume` goes on from, `policy.npz`
the best network on the validation split so far (`gaddpg:weights=FOLDER/policy.npz`), `last.npz` the last one.
"""

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from rich.progress import Progress
from torch.utils.tensorboard import SummaryWriter

from handover_marl.benchmarking.runner import evaluate_run
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.errors import OptionError
from handover_marl.imitation.gaddpg.batches import BatchConfig, Batches
from handover_marl.imitation.gaddpg.expert import ExpertConfig
from handover_marl.imitation.gaddpg.grasp_book import PriceConfig
from handover_marl.imitation.gaddpg.imitation_episodes import EpisodeConfig
from handover_marl.imitation.gaddpg.learner import Learner, LearnerConfig
from handover_marl.imitation.gaddpg.plan_book import CHUNK, Plans, make_plans
from handover_marl.imitation.gaddpg.situations import SituationConfig
from handover_marl.imitation.gaddpg.states import States, joined, read_states, write_states
from handover_marl.imitation.gaddpg.workshop import Workshop, WorkshopConfig, graspable_scenes, made, workshop_of
from handover_marl.models.panda import PANDA_CAMERA
from handover_marl.networks.gaddpg_network import GaddpgNetwork
from handover_marl.networks.own_weights import read_own_weights, write_own_weights
from handover_marl.planning.approach import ApproachConfig
from handover_marl.pools.pool_config import LOCAL
from handover_marl.run import Execution, Run
from handover_marl.training.checkpoint import read_checkpoint, write_checkpoint
from handover_marl.training.learning_curve import CurvePoint
from handover_marl.training.run_folder import RunFolder, origin, spread_scenes

_LAST = "last.npz"
_AHEAD = 1000


@dataclass(frozen=True)
class GaddpgArgs:
    """What to train on, and how long.

    Attributes:
        out: Folder of the run.
        setups: Scenes are those that are in the training splits of all of these, so that no test scene of any of
            them is learned from.
        val_setup: Official setup whose validation split chooses.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        seed: Of everything.
        situations: Objects and starts that the expert plans for.
        rounds: The first is the expert's episodes, the others the network's (DAgger).
        episodes: Episodes of each situation in the first round; in the others each has one.
        share: Of the situations that are played in each of the other rounds.
        updates: Of the network, all rounds together.
        batch: States an update.
        val_scenes: Scenes of the validation split to evaluate on, evenly chosen.
        waits: Waiting times that are evaluated (s); the best network has the highest mean success.
        minutes: Wall-clock time of this start at most (min); the run can be gone on with.
        workers: Processes that plan and play.
        backend: Where they are: local, or ray, on the nodes of a Ray cluster.
        ray_address: Of the cluster; default: where Ray finds one.
        threads: Of PyTorch.
        device: cpu, cuda, or auto.
        resume: Go on with the run in the folder.
        where: Where objects and arms are.
        prices: What grasps cost.
        expert: How the expert chooses goals.
        play: How episodes are played.
        vary: How states are varied.
        learn: How it learns.
        acts: The rule by which the network goes to the grasp that it tells; slower than the expert, since persons
            still move.
        max_steps: Decisions that it may take for it.
    """

    out: str = "runs/gaddpg"
    setups: tuple[str, ...] = ("s0", "s1", "s2", "s3")
    val_setup: str = "s0"
    data_dir: str | None = None
    dataset: str = "auto"
    seed: int = 0
    situations: int = 2000
    rounds: int = 5
    episodes: int = 2
    share: float = 0.5
    updates: int = 15_000
    batch: int = 64
    val_scenes: int = 36
    waits: tuple[float, ...] = (3.0,)
    minutes: float = 600.0
    workers: int = 2
    backend: str = LOCAL
    ray_address: str | None = None
    threads: int = 2
    device: str = "auto"
    resume: bool = False
    where: SituationConfig = field(default_factory=SituationConfig)
    prices: PriceConfig = field(default_factory=PriceConfig)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    play: EpisodeConfig = field(default_factory=EpisodeConfig)
    vary: BatchConfig = field(default_factory=BatchConfig)
    learn: LearnerConfig = field(default_factory=LearnerConfig)
    acts: ApproachConfig = field(default_factory=lambda: ApproachConfig(spare=5))
    max_steps: int = 30


class GaddpgTraining:
    """One run.

    Args:
        args: What and how long.
        script: Name of the script, for the weights' file.

    Raises:
        OptionError: A number is impossible, or there is nothing to learn from.
        ResultsError: The folder holds another run.
    """

    def __init__(self, args: GaddpgArgs, script: str) -> None:
        _check(args)
        torch.set_num_threads(args.threads)
        data = open_dataset(args.dataset, args.data_dir, PANDA_CAMERA)
        scenes = shared_scenes(data, args.setups)
        self.args, self._origin = args, origin(script, args)
        self.folder = RunFolder(Path(args.out), _Kept(args), args.resume, data.name)
        self._work = WorkshopConfig(
            scenes, data.name, args.data_dir, args.seed, args.where, args.prices, args.expert, args.play
        )
        self._how = Execution(args.workers, args.backend, args.ray_address, progress=False)
        self._val = spread_scenes(data.split(args.val_setup, "val"), args.val_scenes)
        name = ("cuda" if torch.cuda.is_available() else "cpu") if args.device == "auto" else args.device
        self._learner = Learner(args.updates, args.seed, torch.device(name), args.learn, args.acts, args.max_steps)
        self._round, self._best, self._started = 0, -1.0, time.monotonic()
        if args.resume and self.folder.checkpoint.exists():
            read_checkpoint(self.folder.checkpoint, self._restore)
            self.folder.forget_after(self._learner.done)
        self._before = self.folder.seconds

    def run(self) -> Path:
        """Train until all is done or the time is up; returns the best network's file."""
        args = self.args
        with Progress() as bar, SummaryWriter(str(self.folder.path / "tensorboard")) as writer:
            task = bar.add_task("plans", total=args.situations)
            plans = make_plans(
                self.folder.path / "plans", self._work, args.situations, self._how.pool, lambda n: bar.advance(task, n)
            )
            if not plans:
                raise OptionError("the expert found no grasp that can be got to in any situation")
            held = self._held_out(plans)
            while self._round < args.rounds and not self._late():
                states = joined([self._states(plans, number, bar) for number in range(self._round + 1)])
                writer.add_scalar("states", len(states), self._learner.done)
                if not self._learn(states, held, bar, writer):
                    break
                self._round += 1
                self._assess(writer)
        return self.folder.policy

    def _late(self) -> bool:
        return time.monotonic() - self._started > 60.0 * self.args.minutes

    def _held_out(self, plans: Plans) -> States:
        """States of the expert in situations that nothing is learned from."""
        path = self._path("held")
        if not path.exists():
            chosen = sorted(plans)[: max(1, len(plans) // 50)]
            write_states(path, workshop_of(self._work).states(chosen, [plans[number] for number in chosen], None, 99))
        return read_states(path)

    def _states(self, plans: Plans, number: int, bar: Progress) -> States:
        """The states of a round, from disk if they are there."""
        path = self._path(f"round-{number}")
        if not path.exists():
            weights = None
            if number > 0:
                last = self.folder.path / _LAST
                write_own_weights(last, self._learner.averaged, {"made by": self._origin})
                # Their content, since who plays may be on another machine.
                weights = last.read_bytes()
            write_states(path, joined(self._played(plans, number, weights, bar)))
        return read_states(path)

    def _played(self, plans: Plans, number: int, weights: bytes | None, bar: Progress) -> list[States]:
        args = self.args
        left = sorted(plans)[max(1, len(plans) // 50) :] or sorted(plans)
        turns = [number] if number > 0 else [-1 - turn for turn in range(args.episodes)]
        if number > 0:
            rng = np.random.default_rng((args.seed, number))
            left = sorted(rng.choice(left, max(1, round(args.share * len(left))), replace=False).tolist())
        groups = [left[first : first + CHUNK] for first in range(0, len(left), CHUNK)]
        tasks = [(group, [plans[one] for one in group], turn + _AHEAD) for turn in turns for group in groups]
        task = bar.add_task(f"episodes, round {number}", total=len(tasks))
        found: dict[int, States] = {}
        for place, states in made(functools.partial(_play, weights), self._work, tasks, self._how.pool):
            found[place] = states
            bar.advance(task)
        # In their order, whoever was first.
        return [found[place] for place in range(len(tasks))]

    def _learn(self, states: States, held: States, bar: Progress, writer: SummaryWriter) -> bool:
        """The updates of a round; tells whether all were made."""
        args, learner = self.args, self._learner
        torch.set_num_threads(args.threads)
        batches = Batches(states, args.expert.approach, args.vary)
        apart = Batches(held, args.expert.approach, args.vary)
        last = args.updates * (self._round + 1) // args.rounds
        task = bar.add_task(f"updates, round {self._round}", total=last, completed=learner.done)
        while learner.done < last:
            # What is drawn follows from the number of the update, so that a run that was stopped goes on as it would.
            rng = np.random.default_rng((args.seed, learner.done))
            told = learner.update(batches.batch(rng.integers(len(states), size=args.batch), rng))
            if learner.done % 50 == 0 or learner.done == last:
                some = np.random.default_rng(0).permutation(len(held))[:256]
                _note(writer, "train", told, learner.done)
                _note(writer, "held_out", learner.assess(apart.batch(some, None)), learner.done)
            if learner.done % 500 == 0:
                write_checkpoint(self.folder.checkpoint, self._state())
                if self._late():
                    return False
            bar.update(task, completed=learner.done)
        return True

    def _assess(self, writer: SummaryWriter) -> None:
        """Play validation scenes with the present network, and keep it if it is the best."""
        args, path = self.args, self.folder.path / _LAST
        write_own_weights(path, self._learner.averaged, {"made by": self._origin})
        scores = []
        for wait in args.waits:
            run = Run(args.val_setup, "val", self._val, args.dataset, args.data_dir, "fast", robot=PANDA_CAMERA)
            chosen = replace(run, receiver=("gaddpg", {"weights": str(path), "wait": wait}))
            report = evaluate_run(chosen, self._how)
            seconds = self._before + time.monotonic() - self._started
            point = CurvePoint.of(report, self._learner.done, seconds, f"replay, wait {wait:g} s")
            self.folder.add(point)
            scores.append(point.success)
            for name in ("success", "contact", "drop", "timeout"):
                writer.add_scalar(f"evaluation/{name} wait {wait:g}", getattr(point, name), self._learner.done)
        if float(np.mean(scores)) > self._best:
            self._best = float(np.mean(scores))
            write_own_weights(self.folder.policy, self._learner.averaged, {"made by": self._origin})
        write_checkpoint(self.folder.checkpoint, self._state())

    def _state(self) -> dict[str, Any]:
        return {"learner": self._learner.state(), "round": self._round, "best": self._best}

    def _restore(self, state: dict[str, Any]) -> None:
        self._learner.restore(state["learner"])
        self._round, self._best = int(state["round"]), float(state["best"])

    def _path(self, name: str) -> Path:
        path = self.folder.path / "states" / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


class _Kept:
    """Arguments that a run is known by, as text and numbers: not where and on how many cores it runs."""

    def __init__(self, args: GaddpgArgs) -> None:
        free = ("workers", "backend", "ray_address", "threads", "device")
        for name, value in vars(args).items():
            if name not in free:
                setattr(self, name, value if isinstance(value, (int, float, str, tuple, type(None))) else repr(value))


def shared_scenes(data: Dataset, setups: Sequence[str]) -> tuple[int, ...]:
    """Scenes in the training splits of all of some setups, whose object has grasps.

    Raises:
        OptionError: There are none.
    """
    common = set.intersection(*(set(data.split(setup, "train")) for setup in setups)) if setups else set[int]()
    scenes = graspable_scenes(data, sorted(common))
    if not scenes:
        raise OptionError(f"setups={list(setups)}: no training scene is in all of these")
    return scenes


def _play(weights: bytes | None, workshop: Workshop, task: tuple[list[int], list[Any], int]) -> States:
    numbers, plans, turn = task
    policy: Callable[..., Any] | None = None
    if weights is not None:
        torch.set_num_threads(1)
        policy = _network(weights).steps
    return workshop.states(numbers, plans, policy, turn)


@functools.lru_cache(maxsize=1)
def _network(weights: bytes) -> Any:
    with TemporaryDirectory() as folder:
        file = Path(folder) / _LAST
        file.write_bytes(weights)
        return read_own_weights(str(file), GaddpgNetwork)[0]


def _note(writer: SummaryWriter, where: str, told: dict[str, float], number: int) -> None:
    for name, value in told.items():
        writer.add_scalar(f"{where}/{name}", value, number)


def _check(args: GaddpgArgs) -> None:
    for name in ("situations", "rounds", "episodes", "updates", "batch", "workers", "threads", "max_steps"):
        if getattr(args, name) < 1:
            raise OptionError(f"{name}={getattr(args, name)} must be 1 or more")
    if not args.waits:
        raise OptionError("waits: at least one waiting time is needed")
