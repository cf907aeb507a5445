"""Arguments that scripts of `experiments/` share, as dataclasses that become command-line options."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from handover_marl.datasets import Dataset, open_dataset
from handover_marl.geometry.panda import PANDA

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class DatasetArgs:
    """Arguments of scripts that read scenes.

    Attributes:
        data_dir: Folder in HandoverSim's layout; default: environment variable HANDOVER_MARL_DATA.
        dataset: Dataset: dexycb, synthetic, generated:n=1000,seed=7, own:FOLDER, or auto.
    """

    data_dir: str | None = None
    dataset: str = "auto"

    def open_dataset(self, robot: str = PANDA) -> Dataset:
        """Open the dataset with a robot model, panda or panda_camera."""
        return open_dataset(self.dataset, self.data_dir, robot)


@dataclass(frozen=True)
class SetupArgs(DatasetArgs):
    """Arguments of scripts that read the scenes of a setup.

    Attributes:
        setup: Official setup, s0 to s3, or a setup of other data; default: the first of the dataset.
    """

    setup: str | None = None

    def resolve_setup(self) -> "Self":
        """Return the arguments with the name of the setup, as `handover_marl.benchmark` chooses it.

        Raises:
            DataNotFoundError: The dataset's folder does not exist.
            UnknownNameError: The dataset has no such setup.
        """
        return replace(self, setup=self.open_dataset().resolve_setup(self.setup))


@dataclass(frozen=True)
class EvaluationArgs(SetupArgs):
    """Arguments of scripts that evaluate policies.

    Attributes:
        physics: Physics engine: fast, exact or mujoco.
        workers: Number of worker processes; default: one per core.
    """

    physics: str = "fast"
    workers: int | None = None

    @property
    def evaluation_options(self) -> dict[str, Any]:
        """Keyword arguments of `handover_marl.evaluate_pair` and `handover_marl.benchmark`."""
        names = ("setup", "dataset", "data_dir", "physics", "workers")
        return {name: getattr(self, name) for name in names}
