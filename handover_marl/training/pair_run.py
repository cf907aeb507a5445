"""What scripts share that train giver and receiver at once: arguments, environment, evaluation of the two together."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from typing_extensions import Self

from handover_marl.benchmarking.runner import evaluate_run
from handover_marl.datasets import open_dataset
from handover_marl.envs.constructors import parallel_env
from handover_marl.envs.encode import EncodedEnv, encode
from handover_marl.envs.parallel_vector_env import ParallelVectorEnv
from handover_marl.envs.vector_env import vector_env
from handover_marl.learning.network import Network
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import PolicySpec
from handover_marl.run import Execution, Run
from handover_marl.training.learning_curve import CurvePoint
from handover_marl.training.run_folder import RunFolder, origin, spread_scenes
from handover_marl.training.training_args import LoopArgs

GIVER, RECEIVER = "giver", "receiver"
_PARTNER = "each other"


@dataclass(frozen=True)
class PairArgs(LoopArgs):
    """What to train, and how.

    Attributes:
        giver_observe: Name of the giver's features.
        giver_actions: Name of its action scheme.
        receiver_observe: Name of the receiver's features.
        receiver_actions: Name of its action scheme.
        width: Units in each of two hidden layers.
        batch: Decisions in all environments between updates.
        minibatch: Decisions that a gradient step looks at.
        clip: PPO's clipping range.
        every: Decisions between evaluations.
        smoke: Only try whether everything runs, with few decisions of few scenes.
    """

    physics: str = "mujoco"
    control_period: float = 0.2
    time_limit: float = 8.0
    steps: int = 49_152
    minutes: float = 30.0
    envs: int = 2
    learning_rate: float = 1e-3
    # Closing sooner must be worth much: at 0.97 it is left to noise, and the mean does not learn to close.
    discount: float = 0.85
    spread: float = 0.4
    val_scenes: int = 18
    giver_observe: str = "giver"
    giver_actions: str = "offer"
    receiver_observe: str = "close"
    receiver_actions: str = "grasp_servo"
    width: int = 128
    batch: int = 2_048
    minibatch: int = 128
    clip: float = 0.2
    every: int = 8_192
    smoke: bool = False

    def names(self, agent: str) -> tuple[str, str]:
        """Names of an agent's features and action scheme."""
        return getattr(self, f"{agent}_observe"), getattr(self, f"{agent}_actions")

    def sized(self) -> Self:
        """The same, or with `smoke` the smallest run that does everything."""
        if not self.smoke:
            return self
        small = replace(self, steps=32, every=32, batch=16, minibatch=8, epochs=1, envs=1, width=8)
        return replace(small, time_limit=1.0, val_scenes=1)


def pair_env(args: PairArgs) -> EncodedEnv:
    """Both agents' environment as they train in it, on the scenes to train on."""
    return encode(parallel_env(**args.env_options()), *_encoding(args))


def pair_envs(args: PairArgs) -> ParallelVectorEnv:
    """The same `args.envs` times in one process, each beginning anew in the step that ends an episode."""
    features, schemes = _encoding(args)
    options = args.env_options()
    return vector_env(args.envs, None, features=features, schemes=schemes, autoreset="same_step", **options)


def _encoding(args: PairArgs) -> tuple[dict[str, str], dict[str, str]]:
    """Features and action schemes by agent."""
    names = {agent: args.names(agent) for agent in (GIVER, RECEIVER)}
    return {agent: features for agent, (features, _) in names.items()}, {
        agent: does for agent, (_, does) in names.items()
    }


class PairRun:
    """A run's folder, its clock and its evaluations: both agents' policies as files, played on the validation split.

    Args:
        args: What is run.
        script: Name of the script, for the policies' files.
    """

    def __init__(self, args: PairArgs, script: str) -> None:
        self.args = args
        data = open_dataset(args.dataset, args.data_dir)
        self.folder = RunFolder(Path(args.out), args, getattr(args, "resume", None), data.name)
        self._origin = origin(script, args)
        val = spread_scenes(data.split(args.setup, "val"), args.val_scenes)
        self._scenes = Run(args.setup, "val", val, args.dataset, args.data_dir, args.physics)
        self._before, self._started = self.folder.seconds, time.monotonic()
        self._due = 0

    @property
    def seconds(self) -> float:
        """Wall-clock time of the run, earlier sessions included (s)."""
        return self._before + time.monotonic() - self._started

    def over(self, steps: int) -> bool:
        """Whether the decisions or the minutes are used up."""
        return steps >= self.args.steps or self.seconds > 60.0 * self.args.minutes

    def due(self, steps: int) -> bool:
        """Whether to evaluate now: at first, every so many decisions, and when it is over."""
        if self.folder.points and self.folder.points[-1].steps == steps:
            return False
        return steps >= self._due or self.over(steps)

    def policy(self, agent: str) -> Path:
        """Where an agent's policy is written."""
        return self.folder.path / f"{agent}.npz"

    def assess(self, steps: int, networks: Mapping[str, Network]) -> CurvePoint:
        """Write both policies, play the validation scenes with them, and draw the learning curve anew.

        Args:
            steps: Decisions so far.
            networks: By agent, from features to outputs.
        """
        self._due = steps - steps % self.args.every + self.args.every
        for agent, network in networks.items():
            sees, does = self.args.names(agent)
            spec = PolicySpec(agent, sees, does, self.args.control_period, self._origin)
            write_policy(self.policy(agent), spec, network)
        names = {agent: f"learned:{self.policy(agent)}" for agent in (GIVER, RECEIVER)}
        report = evaluate_run(replace(self._scenes, **names), Execution(progress=False))  # type: ignore[arg-type]
        point = CurvePoint.of(report, steps, self.seconds, _PARTNER)
        self.folder.add(point)
        print(point.told(), flush=True)
        return point
