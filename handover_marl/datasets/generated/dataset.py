"""Data set of generated scenes, each made when it is loaded."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.generated.config import (
    GENERATED,
    VERSION,
    GeneratedConfig,
    list_split,
    parse_generated_config,
)
from handover_marl.datasets.generated.model_files import write_object_model
from handover_marl.datasets.generated.robot_grasps import RobotGraspConfig
from handover_marl.datasets.generated.scenes import (
    FIRST_CLASS,
    draw_object_grasps,
    draw_procedural_object,
    draw_side,
    generate_scene,
)
from handover_marl.datasets.splits import SPLITS
from handover_marl.datasets.synthetic.dataset import GeneratedHandover, HandoverGenerator
from handover_marl.errors import check_name
from handover_marl.geometry.panda import PANDA
from handover_marl.geometry.ycb import CLASS_NAMES

#: Name of the only setup of generated data.
SETUP = "random"


class GeneratedDataset(HandoverGenerator):
    """Scenes that are generated from a configuration; needs no data folder.

    Args:
        config: Configuration, or its text such as "n=100000,seed=7,family=hard".
        robot: Variant of the Panda, one of `handover_marl.geometry.panda.ROBOTS`.

    Attributes:
        config: Configuration.

    Raises:
        OptionError: The configuration's text is wrong, or a value is out of range.
        UnknownNameError: A parameter, the family or the robot does not exist.
    """

    scene_format = "08d"

    def __init__(self, config: GeneratedConfig | str, robot: str = PANDA) -> None:
        super().__init__(robot)
        self.config = parse_generated_config(config) if isinstance(config, str) else config
        self.name = f"{GENERATED}:{self.config.argument}"
        self._numbers = {f"object_{number:05d}": number for number in range(self.config.objects)}
        self._names = {**CLASS_NAMES, **{FIRST_CLASS + number: name for name, number in self._numbers.items()}}

    @property
    def n_scenes(self) -> int:
        """Number of scenes; they are numbered from 0."""
        return self.config.n

    @property
    def setups(self) -> tuple[str, ...]:
        """Name of the only setup: scenes and procedural objects are split by a hash of their number."""
        return (SETUP,)

    @property
    def object_names(self) -> Mapping[int, str]:
        """Class names by class number: the YCB classes, then procedural objects such as "object_00042"."""
        return self._names

    @property
    def quick_validation(self) -> bool:
        """Whether grasps are validated with few simulations, because there are very many object classes."""
        return True

    def list_scenes(self, setup: str | None, split: str) -> tuple[int, ...]:
        """Return the scene numbers of a split in ascending order."""
        self.resolve_setup(setup)
        check_name("split", split, SPLITS)
        return tuple(list_split(split, self.config.n).tolist())

    def find_side(self, scene_id: int) -> str:
        """Return the hand of a scene's giver without generating the scene."""
        self.check_scene_id(scene_id)
        return draw_side(self.config, scene_id)

    def generate(self, scene_id: int) -> GeneratedHandover:
        """Generate an existing scene."""
        return generate_scene(self.config, scene_id)

    def find_object_urdf(self, object_name: str) -> Path:
        """Return the path of a class's URDF; the URDF of a procedural object is written on first use."""
        if object_name not in self._numbers:
            return super().find_object_urdf(object_name)
        return write_object_model(object_name, draw_procedural_object(self.config, self._numbers[object_name]))

    def load_grasps(self, object_name: str) -> npt.NDArray[np.float64] | None:
        """Return robot grasps (n, 4, 4) of a class, or None if it has none.

        Grasps of shipped objects have held the object in simulation. Grasps of procedural objects are
        antipodal and do not collide with the object; they are not simulated.
        """
        if object_name not in self._numbers:
            return super().load_grasps(object_name)
        grasps = draw_object_grasps(self.config, self._numbers[object_name], RobotGraspConfig())
        return grasps if len(grasps) else None

    def compute_fingerprint(self, scene_id: int) -> str:
        """Return version and configuration of the generator; the number of scenes does not matter."""
        return f"{GENERATED}-{VERSION}-{self.name.partition(',')[2]}"
