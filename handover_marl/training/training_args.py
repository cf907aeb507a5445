"""The arguments that all training scripts have, and the environment that is trained in."""

import math
from dataclasses import dataclass, replace

from handover_marl.datasets import open_dataset
from handover_marl.envs.constructors import EnvOptions
from handover_marl.envs.rewards import reward_config
from handover_marl.training.run_folder import training_scenes


@dataclass(frozen=True)
class LoopArgs:
    """What to train on, and how long.

    Attributes:
        out: Folder of the run.
        setup: Official setup, s0 to s3.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        physics: fast, exact, or mujoco, where environments are simulated in batches.
        control_period: How long an action stands (s).
        time_limit: Episodes in training are cut off after so long (s).
        seed: Of everything.
        steps: Decisions of an agent at most.
        minutes: Wall-clock time at most (min).
        envs: Environments.
        epochs: Passes over what was collected between updates.
        learning_rate: Of Adam.
        discount: Of rewards; guidance is made for it.
        rewards: sparse or shaped.
        trace: GAE's lambda.
        spread: Standard deviation of the outputs at first.
        val_scenes: Scenes of the validation split to evaluate on, evenly chosen.
    """

    out: str = "runs/training"
    setup: str = "s0"
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "fast"
    control_period: float = 0.1
    time_limit: float = 13.0
    seed: int = 0
    steps: int = 500_000
    minutes: float = 60.0
    envs: int = 8
    epochs: int = 8
    learning_rate: float = 3e-4
    discount: float = 0.99
    rewards: str = "sparse"
    trace: float = 0.95
    spread: float = 0.5
    val_scenes: int = 36

    @property
    def max_cycles(self) -> int:
        """Decisions after which episodes in training are cut off."""
        return math.ceil(self.time_limit / self.control_period)

    def env_options(self) -> EnvOptions:
        """Options of the two-agent environment, on the scenes to train on."""
        data = open_dataset(self.dataset, self.data_dir)
        return {
            "setup": self.setup,
            "split": "train",
            "data_dir": self.data_dir,
            "dataset": self.dataset,
            "physics": self.physics,
            "control_period": self.control_period,
            "rewards": replace(reward_config(self.rewards), gamma=self.discount),
            "scenes": training_scenes(data.split(self.setup, "train")),
            "max_cycles": self.max_cycles,
        }


@dataclass(frozen=True)
class TrainingArgs(LoopArgs):
    """What to train on, and how long.

    Attributes:
        resume: Go on with the run in the folder.
    """

    resume: bool = False
