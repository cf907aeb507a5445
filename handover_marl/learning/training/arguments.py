"""Arguments of the training scripts, as dataclasses that become command-line options."""

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from handover_marl.envs.config import EnvConfig
from handover_marl.envs.custom_rewards import set_discount
from handover_marl.errors import OptionError
from handover_marl.learning.encodings.choices import is_reference
from handover_marl.learning.training.run_folder import select_training_scenes
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.simulation.engines import MUJOCO

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class TrainingArgs(SetupArgs):
    """Arguments of all scripts that train policies by reinforcement learning.

    Attributes:
        seed: Seed of all random numbers.
        width: Width of the two hidden layers of each network.
        time_limit: Time after which training episodes are truncated (s).
        control_period: Time between two decisions (s).
        physics: Simulation: fast, exact, or mujoco, which simulates environments in batches.
        num_envs: Number of environments simulated in parallel.
        decisions: Largest number of decisions of an agent.
        minutes: Largest wall-clock time (min).
        val_scenes: Number of validation scenes per evaluation, evenly chosen.
        out: Folder of the run.
        batch_size: Number of decisions in all environments together between updates.
        eval_interval: Number of decisions between evaluations.
        epochs: Number of passes over the collected data between updates.
        learning_rate: Learning rate of Adam.
        rewards: Reward: sparse, shaped, or module:name of a user-defined reward.
        discount: Discount factor; potential-based rewards use it too.
        gae_lambda: Lambda of generalized advantage estimation.
        initial_std: Initial standard deviation of the network outputs, for exploration.
    """

    seed: int = 0
    width: int = 128
    time_limit: float = 8.0
    control_period: float = 0.2
    physics: str = "mujoco"
    num_envs: int = 2
    decisions: int = 49_152
    minutes: float = 30.0
    val_scenes: int = 18
    out: str = "runs/training"
    batch_size: int = 2_048
    eval_interval: int = 8_192
    epochs: int = 8
    learning_rate: float = 1e-3
    rewards: str = "sparse"
    # With 0.97 the mean of a pair never learns to close the gripper; exploration noise closes it late enough.
    discount: float = 0.85
    gae_lambda: float = 0.95
    initial_std: float = 0.4

    def __post_init__(self) -> None:
        # `module:name` may be in the working folder, which Python does not search when it runs a script.
        folder = str(Path.cwd())
        if folder not in sys.path and any(is_reference(value) for value in vars(self).values()):
            sys.path.append(folder)

    @property
    def max_cycles(self) -> int:
        """Number of decisions after which training episodes are truncated."""
        return math.ceil(self.time_limit / self.control_period)

    def make_env_config(self) -> EnvConfig:
        """Create the configuration of the environment on the training scenes."""
        return EnvConfig(
            setup=self.setup,
            split="train",
            data_dir=self.data_dir,
            dataset=self.dataset,
            physics=self.physics,
            control_period=self.control_period,
            rewards=set_discount(self.rewards, self.discount),
            scenes=select_training_scenes(self.open_dataset().list_scenes(self.setup, "train")),
            max_cycles=self.max_cycles,
        )


@dataclass(frozen=True)
class ResumableArgs(TrainingArgs):
    """Arguments of training scripts that write checkpoints.

    Attributes:
        resume: Whether to continue the run in the folder `out`.
    """

    resume: bool = False


@dataclass(frozen=True)
class PpoArgs(ResumableArgs):
    """Arguments of the scripts that train one agent with Stable-Baselines3's PPO.

    Attributes:
        features: Name of the features that the learning agent observes, or module:name of user-defined features.
        actions: Name of the learning agent's action scheme, or module:name of a user-defined scheme.
        num_envs: Number of environments simulated in parallel; 0 means 64 with mujoco, else 8.
        eval_start: Whether to evaluate before the training, too.
    """

    features: str = "close"
    actions: str = "grasp_servo"
    num_envs: int = 0
    eval_start: bool = True
    val_scenes: int = 36

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch_size < self.resolved_num_envs:
            raise OptionError(
                f"batch_size must be at least the number of environments, {self.resolved_num_envs}, got "
                f"{self.batch_size}; choose fewer with num_envs"
            )

    @property
    def resolved_num_envs(self) -> int:
        """Number of environments simulated in parallel, where `num_envs` may be 0."""
        return self.num_envs or (64 if self.physics == MUJOCO else 8)


@dataclass(frozen=True)
class PairArgs(TrainingArgs):
    """Arguments of the scripts that train giver and receiver together.

    Attributes:
        giver_features: Name of the giver's features, or module:name of user-defined features.
        giver_actions: Name of the giver's action scheme, or module:name of a user-defined scheme.
        receiver_features: Name of the receiver's features, or module:name of user-defined features.
        receiver_actions: Name of the receiver's action scheme, or module:name of a user-defined scheme.
        minibatch_size: Number of decisions per gradient step.
        clip_range: Largest deviation from 1 of the probability ratio in PPO's objective.
        smoke_test: Whether to run with the smallest sizes, to test that everything works.
    """

    giver_features: str = "giver"
    giver_actions: str = "offer"
    receiver_features: str = "close"
    receiver_actions: str = "grasp_servo"
    minibatch_size: int = 128
    clip_range: float = 0.2
    smoke_test: bool = False

    @property
    def encodings(self) -> dict[str, tuple[str, str]]:
        """Pair of the names of features and action scheme, for each of "giver" and "receiver"."""
        return {
            "giver": (self.giver_features, self.giver_actions),
            "receiver": (self.receiver_features, self.receiver_actions),
        }

    def shrink_for_smoke_test(self) -> "Self":
        """Return arguments with the smallest sizes if `smoke_test` is set, else the same arguments."""
        if not self.smoke_test:
            return self
        small = replace(
            self, decisions=32, eval_interval=32, batch_size=16, minibatch_size=8, epochs=1, num_envs=1, width=8
        )
        return replace(small, time_limit=1.0, val_scenes=1)
