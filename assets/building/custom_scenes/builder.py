"""Folder of custom scenes to which objects, motions and splits can be added."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
import trimesh
from rich.console import Console

from handover_marl.assets.building.custom_scenes.finger_closing import close_hand
from handover_marl.assets.building.custom_scenes.motion_tables import (
    ARRAY_NAMES,
    OBJECT,
    MotionConfig,
    make_trajectory,
    read_motion_table,
)
from handover_marl.assets.building.custom_scenes.object_meshes import MeshConfig, make_object_mesh, write_object
from handover_marl.assets.building.grasps import make_robot_grasps
from handover_marl.assets.hand_model import Side, make_hand_geometry
from handover_marl.assets.shipped import URDF_NAME, find_object_urdf
from handover_marl.config import MAX_OBJECTS, OBJECT_DOF
from handover_marl.datasets.custom.dataset import (
    GRASP_FILE,
    MOTION_FOLDER,
    OBJECT_FOLDER,
    CustomDataset,
    get_motion_path,
)
from handover_marl.datasets.custom.motion_checks import check_motion, check_objects
from handover_marl.datasets.custom.scene_file import (
    RESERVED_SETUPS,
    SCENE_FILE,
    CustomObject,
    CustomScene,
    SceneFile,
    check_file_name,
    read_scene_file,
)
from handover_marl.datasets.generated.shapes import read_solid
from handover_marl.datasets.splits import SPLITS
from handover_marl.errors import DataFormatError, HandoverError, OptionError, ResultsError, check_name
from handover_marl.execution.files import exclusive_lock, write_arrays
from handover_marl.execution.options import check_path
from handover_marl.geometry.model_files.meshes import check_model, read_collision_mesh
from handover_marl.geometry.ycb import CLASS_NAMES, LARGEST_YCB_CLASS


class CustomSceneFolder:
    """Folder of custom scenes, created when the first object or motion is added; its methods also add splits.

    Every method checks its arguments first and writes the folder last, so that an error leaves the folder unchanged.

    Args:
        folder: Path of the folder, whose name is the name of the data set in results.

    Raises:
        OptionError: `folder` is not a path, or its name is not 1 to 64 letters, digits, '_', '.' or '-', of which the
            first is a letter or digit.
        ResultsError, DataFormatError: The folder has files, but no `scenes.json`, or a damaged one.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = check_path("folder", folder).resolve()
        if not (self.folder / SCENE_FILE).exists():
            check_file_name("the name of the folder", self.folder.name)
            if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
                raise ResultsError(f"{self.folder} must be a new folder, or one with {SCENE_FILE}; choose another one")

    @property
    def content(self) -> SceneFile:
        """Objects, scenes and splits of the folder."""
        exists = (self.folder / SCENE_FILE).exists()
        return read_scene_file(self.folder) if exists else SceneFile(self.folder.name)

    @property
    def dataset(self) -> str:
        """Name with which functions and commands open the scenes as a data set (`own` and the folder)."""
        return f"own:{self.folder}"

    def add_object(
        self,
        name: str,
        mesh: "str | os.PathLike[str] | trimesh.Trimesh",
        config: MeshConfig | None = None,
        *,
        grasps: int = 60,
        seed: int = 0,
        workers: int | None = None,
        progress: bool = True,
    ) -> CustomObject:
        """Add an object class from a triangle mesh, with convex parts and robot grasps.

        Args:
            name: Class name of the object.
            mesh: Mesh file of any format that trimesh reads, or a mesh. Recorded poses are poses of its frame.
            config: Units of the mesh, and mass, friction and color of the object; default: `MeshConfig()`.
            grasps: Number of robot grasps to find in simulation; 0 for none.
            seed: Random seed of the grasps.
            workers: Number of worker processes; default: one per core. The result does not depend on it.
            progress: Whether to show progress bars on stderr.

        Returns:
            The object, with the number of grasps that held it and the repairs of its mesh.

        Raises:
            OptionError: An argument is out of range, or a YCB class or an object of the folder has the name already.
            DataNotFoundError, DataFormatError, ResultsError: No mesh file, no solid body, or no access to the folder.
        """
        text = check_file_name("name", name, (*CLASS_NAMES.values(), *ARRAY_NAMES))
        config = config or MeshConfig()
        source = mesh if isinstance(mesh, trimesh.Trimesh) else check_path("mesh", mesh)
        self._check_is_new(text, self.content)
        with Console(stderr=True, quiet=not progress).status("convex parts"):
            item = make_object_mesh(source, config)
        with tempfile.TemporaryDirectory() as scratch:
            model = Path(scratch) / text
            model.mkdir()
            write_object(model, item, config)
            found, n_candidates = make_robot_grasps(model / URDF_NAME, grasps, seed, workers, progress)
            write_arrays(model / GRASP_FILE, {"grasps": found.astype(np.float32)})
            with self._change(OBJECT_FOLDER) as content:
                # Another process may have added an object of this name in the meantime.
                self._check_is_new(text, content)
                added = CustomObject(
                    name=text,
                    number=max([LARGEST_YCB_CLASS, *(other.number for other in content.objects)]) + 1,
                    mass=round(item.mass, 6),
                    friction=float(config.friction),
                    n_grasps=len(found),
                    n_candidates=n_candidates,
                    repairs=item.repairs,
                )
                target = self.folder / OBJECT_FOLDER / text
                # Files that an interrupted call has left there belong to no object.
                shutil.rmtree(target, ignore_errors=True)
                shutil.copytree(model, target)
                replace(content, objects=(*content.objects, added)).write(self.folder)
        return added

    def add_motion(
        self,
        motion: "str | os.PathLike[str] | Mapping[str, npt.ArrayLike]",
        object_name: str,
        subject: str,
        config: MotionConfig | None = None,
        *,
        recording: str | None = None,
        side: str = "right",
        hand: int | None = 6,
        others: Sequence[str] = (),
    ) -> CustomScene:
        """Add a scene: the recorded motion of an object, a wrist and other objects.

        Args:
            motion: CSV or NPZ file of poses, or arrays with the names of an NPZ file; see
                `handover_marl.assets.building.custom_scenes.motion_tables`.
            object_name: Class of the object that is handed over: a class of the folder or a YCB class.
            subject: Name of the person, for splits.
            config: Frames and units of the recording; default: `MotionConfig()`.
            recording: Name of the recording; default: the number of the scene.
            side: Hand of the person, "right" or "left".
            hand: Number of the shipped hand, 1 to 10, by default a man's of mean length; None for a scene without a
                hand. Its fingers follow the recording; if it has none, they close on the object before the pick-up.
            others: Classes of the other objects on the table, each with poses in the recording.

        Returns:
            The scene, with the repairs of its motion.

        Raises:
            OptionError, ResultsError: An argument is out of range, or the folder cannot be written.
            UnknownNameError: A class, a side or a hand does not exist.
            DataNotFoundError, DataFormatError: The recording is missing, malformed, or not at the table.
        """
        names = (object_name, *others)
        for item in names:
            check_name("object", item, self.content.object_names.values())
        if len(names) > MAX_OBJECTS or len(set(names)) < len(names):
            raise OptionError(f"others must be at most {MAX_OBJECTS - 1} different classes, got {', '.join(others)}")
        check_file_name("subject", subject)
        scene = CustomScene(f"{subject}/{recording or 0}", side, hand, names)
        source = motion if isinstance(motion, Mapping) else check_path("motion", motion)
        table = read_motion_table(source, config or MotionConfig())
        missing, unknown = set(others) - set(table.bodies), set(table.bodies) - {OBJECT, *others}
        if missing or unknown:
            raise DataFormatError(
                f"the motion has {'no ' if missing else ''}poses of {min(missing or unknown)!r}; the names in others "
                "must be those of its columns"
            )
        urdfs = [self._find_urdf(item) for item in names]
        bodies = {name: read_collision_mesh(urdf)[0] for name, urdf in zip((OBJECT, *others), urdfs, strict=True)}
        check_objects(make_trajectory(table, others, None, None)["object_dof"], bodies)
        model, fingers = None, table.fingers
        if hand is not None:
            model = make_hand_geometry(hand, cast(Side, side))
            if fingers is None:
                table, fingers = close_hand(table, read_solid(urdfs[0]), hand, cast(Side, side))
        arrays = make_trajectory(table, others, model, fingers)
        first, last = (None, None) if model is None else arrays["hand_span"].tolist()
        check_motion(arrays["object_dof"], arrays["hand_dof"], first, last, bodies)
        with self._change(MOTION_FOLDER) as content:
            number = len(content.scenes)
            scene = replace(scene, name=f"{subject}/{recording or f'{number:06d}'}", repairs=table.repairs)
            if scene.name in [other.name for other in content.scenes]:
                raise OptionError(
                    f"recording must be new, got {scene.name!r}, which {self.folder} has already; rename it"
                )
            write_arrays(get_motion_path(self.folder, number), arrays)
            # The new scene is in no split until the splits are made again.
            replace(content, scenes=(*content.scenes, scene)).write(self.folder)
        return scene

    def add_split(
        self, name: str, by: str, *, val: Iterable[str] | float = 0.2, test: Iterable[str] | float = 0.2, seed: int = 0
    ) -> dict[str, tuple[int, ...]]:
        """Add a setup: a division of all scenes into train, val and test.

        Args:
            name: Name of the setup; an existing one is replaced.
            by: "object" or "person": each handed-over object or person is then in one split only; or "random": by
                scene. Other objects on the table may be in several splits.
            val: Names of the val split's objects or persons, or a share (0 to 1) of all, which is drawn at random.
            test: Names or share for the test split, as in `val`.
            seed: Random seed of drawn shares.

        Returns:
            Scene numbers of each split.

        Raises:
            OptionError: The name is reserved, a share is out of range, or the train split would be empty.
            UnknownNameError: There is no such way to divide scenes, or no such object or person.
            ResultsError: The folder does not exist, or cannot be written.
        """
        check_file_name("name", name, RESERVED_SETUPS)
        if not self.folder.is_dir():
            raise ResultsError(f"{self.folder} does not exist; add an object or a motion first")
        with self._change() as content:
            setup = _split_scenes(content, by, {"val": val, "test": test}, seed)
            replace(content, setups={**content.setups, name: setup}).write(self.folder)
        return setup

    def check(self) -> CustomDataset:
        """Check every file of the folder by loading all scenes, models and grasps; return the data set.

        Raises:
            DataNotFoundError, DataFormatError: A file is missing or damaged.
        """
        dataset = CustomDataset(self.folder)
        for item in dataset.content.objects:
            check_model(dataset.find_object_urdf(item.name), OBJECT_DOF)
            dataset.load_grasps(item.name)
        for scene_id in range(dataset.n_scenes):
            dataset.load_scene(scene_id)
        return dataset

    def _check_is_new(self, name: str, content: SceneFile) -> None:
        if name in [item.name for item in content.objects]:
            raise OptionError(f"name must be new, got {name!r}, which {self.folder} has already; choose another one")

    def _find_urdf(self, name: str) -> Path:
        is_ycb = name in CLASS_NAMES.values()
        return find_object_urdf(name) if is_ycb else self.folder / OBJECT_FOLDER / name / URDF_NAME

    @contextlib.contextmanager
    def _change(self, subfolder: str = "") -> Iterator[SceneFile]:
        """Create and lock the folder in a `with` block, against other processes, and yield its present content."""
        try:
            (self.folder / subfolder).mkdir(parents=True, exist_ok=True)
            with exclusive_lock(self.folder):
                yield self.content
        except HandoverError:
            raise
        except OSError as error:
            raise ResultsError(f"cannot write to {self.folder} ({error.strerror or error})") from error


def _split_scenes(
    content: SceneFile, by: str, shares: Mapping[str, Iterable[str] | float], seed: int
) -> dict[str, tuple[int, ...]]:
    check_name("by", by, ("object", "person", "random"))
    keys = [
        {"object": scene.objects[0], "person": scene.subject, "random": str(number)}[by]
        for number, scene in enumerate(content.scenes)
    ]
    if not keys:
        raise OptionError("a split needs scenes, got a folder without scenes; add them with add_motion")
    groups = list(dict.fromkeys(keys))
    drawn = [groups[index] for index in np.random.default_rng(seed).permutation(len(groups))]
    home: dict[str, str] = {}
    # Names of the caller first, so that none of them is drawn for the other split.
    for split, chosen in sorted(shares.items(), key=lambda item: isinstance(item[1], (int, float))):
        if isinstance(chosen, str):
            raise OptionError(
                f"{split} must be a share from 0 to 1 or a list of names, got {chosen!r}; pass [{chosen!r}]"
            )
        if isinstance(chosen, (int, float)):
            if not 0.0 <= chosen < 1.0:
                raise OptionError(f"{split} must be a share from 0 to 1 or a list of names, got {chosen!r}")
            count = round(chosen * len(groups)) or int(chosen > 0.0)
            members = [key for key in drawn if key not in home][:count]
        else:
            members = [str(key) for key in chosen]
        for key in members:
            check_name(by, key, groups)
            if key in home:
                raise OptionError(f"val and test must not share a name, got {key!r} in both; remove it from one")
            home[key] = split
    setup = {
        split: tuple(number for number, key in enumerate(keys) if home.get(key, "train") == split) for split in SPLITS
    }
    if not setup["train"]:
        raise OptionError(
            f"the train split must not be empty, got all {len(keys)} scenes in val and test; lower the shares"
        )
    return setup
