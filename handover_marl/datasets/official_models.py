"""Models and grasps in HandoverSim's folder `assets/`: where they are, and where they come from."""

import os
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.official_files import PANDA_FILES, WITHOUT_GRASPS, Origin, file_origin, hand_origin
from handover_marl.datasets.pickled_grasps import load_grasps
from handover_marl.datasets.scene import SceneAssets, SceneInfo
from handover_marl.errors import DataNotFoundError
from handover_marl.models.urdf_shapes import named_meshes

if TYPE_CHECKING:
    from hashlib import _Hash


class OfficialModels:
    """What scenes are played with.

    Args:
        assets: The folder.
        robot: Which Panda stands in the scenes.
    """

    def __init__(self, assets: Path, robot: str) -> None:
        self._assets, self._robot = assets, robot
        self._grasps = lru_cache(maxsize=None)(self._read_grasps)
        self._origin = lru_cache(maxsize=None)(self._read_origin)
        self._hand_origin = lru_cache(maxsize=None)(lambda folder: _told(lambda: hand_origin(folder)))

    @property
    def panda(self) -> Path:
        """The robot.

        Raises:
            DataNotFoundError: It is not there.
        """
        return self._asset(PANDA_FILES[self._robot])

    def object(self, name: str) -> Path:
        """An object class's model.

        Raises:
            DataNotFoundError: It is not there.
        """
        return self._asset(f"{name}/model_normalized.urdf")

    def of_scene(self, info: SceneInfo) -> SceneAssets:
        """All of a scene's.

        Raises:
            DataNotFoundError: One is not there.
        """
        return SceneAssets(
            table=self._asset("table/table.urdf"),
            panda=self.panda,
            objects=tuple(self.object(name) for name in info.object_names),
            hand=self._asset(f"{info.subject}_{info.side}/mano.urdf"),
        )

    def grasps(self, name: str) -> npt.NDArray[np.float64] | None:
        """(n, 4, 4) gripper poses in the object's frame (m), or None for a class that has none.

        Raises:
            DataNotFoundError: The grasp file of another class is missing.
            UnsafeFileError, DataFormatError: The file holds foreign content or is damaged.
        """
        return self._grasps(name)

    def grasp_file(self, name: str) -> Path | None:
        """Where a class's grasps are, or None for a class that has none.

        Raises:
            DataNotFoundError: The grasp file of another class is missing.
        """
        path = self._assets / "grasps" / f"{name}.npy"
        return None if name in WITHOUT_GRASPS and not path.is_file() else existing(path)

    def hash_into(self, digest: "_Hash", info: SceneInfo) -> None:
        """Add the given object's grasps, a scene's URDFs and the sizes of their meshes to a hash."""
        assets, grasps = self.of_scene(info), self.grasp_file(info.target_name)
        if grasps is not None:
            digest.update(grasps.read_bytes())
        for urdf in (assets.table, assets.panda, assets.hand, *assets.objects):
            digest.update(urdf.read_bytes())
            digest.update(_mesh_sizes(urdf))

    def in_words(self, info: SceneInfo) -> str:
        """Which hand a scene is played with, and what else is not HandoverSim's own."""
        parts = [self._origin(f"{name}/model_normalized_convex.obj") for name in info.object_names]
        grasps = self._origin(f"grasps/{info.target_name}.npy")
        hand = self._hand_origin(self._assets / f"{info.subject}_{info.side}")
        said = ["MANO hand"] if hand is Origin.ORIGINAL else _strange("hand", hand)
        said += _strange("convex parts", *parts)
        said += [] if info.target_name in WITHOUT_GRASPS else _strange("grasps", grasps)
        said += _strange("Panda", self._origin(PANDA_FILES[self._robot]))
        return ", ".join(said)

    def _asset(self, relative: str) -> Path:
        return existing(self._assets / relative)

    def _read_grasps(self, name: str) -> npt.NDArray[np.float64] | None:
        path = self.grasp_file(name)
        return None if path is None else load_grasps(path)

    def _read_origin(self, path: str) -> Origin:
        return _told(lambda: file_origin(path, (self._assets / path).read_bytes()))


def existing(path: Path) -> Path:
    """The path itself.

    Raises:
        DataNotFoundError: There is no file, or none that may be read.
    """
    try:
        there = path.is_file() and os.access(path, os.R_OK)
    except OSError as error:
        raise DataNotFoundError(f"{path} cannot be read ({error.strerror or error}); check its rights") from error
    if path.exists() and not there:
        raise DataNotFoundError(f"{path} cannot be read; check its rights")
    if not there:
        raise DataNotFoundError(
            f"{path} is missing. The data folder is incomplete (handover-marl doctor tells what is): copy or expand "
            "the HandoverSim data again."
        )
    return path


def _strange(what: str, *origins: Origin) -> list[str]:
    """What is said of things that are not all HandoverSim's own."""
    if Origin.STAND_IN in origins:
        return [f"stand-in {what}"]
    return [f"{what} of unknown origin"] if Origin.UNKNOWN in origins else []


def _told(read: Callable[[], Origin]) -> Origin:
    try:
        return read()
    except OSError:
        return Origin.UNKNOWN


def _mesh_sizes(urdf: Path) -> bytes:
    """Names and sizes of the meshes that a model refers to; hashing their bytes would take seconds."""
    sizes = [
        b"%s %d" % (name.encode(), mesh.stat().st_size if mesh.is_file() else -1) for name, mesh in named_meshes(urdf)
    ]
    return b"\n".join(sizes)
