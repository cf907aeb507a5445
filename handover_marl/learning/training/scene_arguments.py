"""Command-line arguments that the scripts in `experiments/` share, as dataclasses, and a function to run a script."""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import tyro

from handover_marl.datasets import Dataset, open_dataset
from handover_marl.errors import HandoverError
from handover_marl.geometry.panda import PANDA

if TYPE_CHECKING:
    from typing import Self

# Every tenth scene of a training split is held out.
_HELD_OUT = 10
_Args = TypeVar("_Args")
_Result = TypeVar("_Result")


def run_script(main: Callable[[_Args], _Result], arguments: type[_Args], description: str | None) -> _Result:
    """Call a script's function `main` with the parsed command line; exit on library errors without a traceback."""
    try:
        return main(tyro.cli(arguments, description=description))
    except HandoverError as error:
        sys.exit(f"error: {error}")


def select_training_scenes(scene_ids: Sequence[int]) -> tuple[int, ...]:
    """Return the scenes of a training split that are used for training: all but the 1st, 11th, ..., or the only one."""
    return tuple(scene for number, scene in enumerate(scene_ids) if number % _HELD_OUT) or tuple(scene_ids)


def select_held_out_scenes(scene_ids: Sequence[int]) -> tuple[int, ...]:
    """Return the 1st, 11th, ... scene of a training split: held out from training to measure losses and success."""
    return tuple(scene_ids[::_HELD_OUT])


@dataclass(frozen=True)
class SetupArgs:
    """Arguments of scripts that read the scenes of a setup.

    Attributes:
        data_dir: Folder in HandoverSim's layout; default: environment variable HANDOVER_MARL_DATA.
        dataset: Dataset: dexycb, synthetic, generated:n=1000,seed=7, own:FOLDER, or auto.
        setup: Official setup, s0 to s3, or a setup of other data; default: the first of the dataset.
    """

    data_dir: str | None = None
    dataset: str = "auto"
    setup: str | None = None

    def open_dataset(self, robot: str = PANDA) -> Dataset:
        """Open the dataset that the arguments name, with a robot model, "panda" or "panda_camera"."""
        return open_dataset(self.dataset, self.data_dir, robot)

    def resolve_setup(self) -> "Self":
        """Return a copy of the arguments in which `setup` is a name; None becomes the first setup of the dataset."""
        return replace(self, setup=self.open_dataset().resolve_setup(self.setup))

    @property
    def scene_options(self) -> dict[str, Any]:
        """Keyword arguments of environments with the training scenes, see `select_training_scenes`."""
        dataset = self.open_dataset()
        scenes = select_training_scenes(dataset.list_scenes(dataset.resolve_setup(self.setup), "train"))
        where = {"setup": self.setup, "dataset": self.dataset, "data_dir": self.data_dir}
        return where | {"split": "train", "scenes": scenes}


@dataclass(frozen=True)
class RlArgs(SetupArgs):
    """Arguments of scripts that train policies by PPO.

    Attributes:
        seed: Seed of all random numbers.
        physics: Simulation: fast, exact, or mujoco, which simulates environments in batches.
        num_envs: Number of environments simulated in parallel.
        decisions: Largest number of decisions of each agent that learns.
        batch_size: Number of decisions in all environments together between updates.
        epochs: Number of passes over the collected decisions in each update.
        minibatch_size: Number of decisions per gradient step.
        learning_rate: Learning rate of Adam.
        discount: Discount factor, also of potential-based rewards. With 0.97, two agents that learn together rely on
            exploration noise to close the gripper, and their mean actions never close it.
        gae_lambda: Lambda of generalized advantage estimation.
        clip_range: Largest deviation from 1 of the probability ratio in PPO's objective.
        width: Width of the two hidden layers of each network.
        initial_std: Initial standard deviation of the network outputs, for exploration.
        control_period: Time between two decisions (s).
        time_limit: Time after which training episodes are truncated (s).
        val_scenes: Number of validation scenes per evaluation, evenly chosen.
    """

    seed: int = 0
    physics: str = "mujoco"
    num_envs: int = 2
    decisions: int = 49_152
    batch_size: int = 2_048
    epochs: int = 8
    minibatch_size: int = 128
    learning_rate: float = 1e-3
    discount: float = 0.85
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    width: int = 128
    initial_std: float = 0.4
    control_period: float = 0.2
    time_limit: float = 8.0
    val_scenes: int = 36

    @property
    def env_options(self) -> dict[str, Any]:
        """Keyword arguments of training environments: scenes, physics, control period and largest number of steps."""
        return self.scene_options | {name: getattr(self, name) for name in ("physics", "control_period", "max_cycles")}

    @property
    def max_cycles(self) -> int:
        """Number of decisions after which training episodes are truncated: `time_limit` / `control_period`."""
        return math.ceil(self.time_limit / self.control_period)
