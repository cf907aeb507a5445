"""MuJoCo Warp models whose worlds have different objects and hands.

All worlds of a model have one layout: equal array sizes and constants. Worlds differ in hulls, masses and motors. These
are in arrays of the model with one row for each world. On the device, a row is copied from the world's scene.
"""

import copy
import dataclasses
import functools
import hashlib
from weakref import WeakKeyDictionary

import mujoco
import mujoco_warp
import numpy as np
import numpy.typing as npt
import warp

from handover_marl.config import OBJECT_DOF, PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.errors import OptionError
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, GrowableArray, expand_mask, get_namespace
from handover_marl.simulation.mujoco.models.scene_model import SceneModel, load_scene_model
from handover_marl.simulation.mujoco.models.scene_spec import ABSENT_PREFIX, ModelPadding, load_object_parts

# Arrays with an entry for each mesh, each vertex or each polygon, which are copied as they are.
_MESH_ARRAYS = ("mesh_vertnum", "mesh_polynum", "mesh_pos", "mesh_quat")
_VERTEX_ARRAYS = ("mesh_vert", "mesh_polymapnum")
_POLYGON_ARRAYS = ("mesh_polynormal", "mesh_polyvertnum")
# Arrays of addresses, and for each the array that its addresses point into.
_TARGETS = {"mesh_polyvertadr": "mesh_polyvert", "mesh_polymapadr": "mesh_polymap"}


class MeshPool:
    """Collection of the distinct meshes of compiled models.

    Attributes:
        arrays: Arrays of all meshes by MuJoCo's names, e.g. "mesh_vert".
    """

    def __init__(self) -> None:
        self.arrays: dict[str, npt.NDArray[np.generic]] = {}
        self._numbers: dict[bytes, int] = {}

    def add(self, model: "mujoco.MjModel") -> npt.NDArray[np.int_]:
        """Add a model's meshes that are not in the pool yet; return the pool number of each mesh of the model."""
        numbers = []
        for mesh in range(model.nmesh):
            start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            key = model.mesh_vert[start : start + count].tobytes()
            if key not in self._numbers:
                self._numbers[key] = len(self._numbers)
                self._append(_select_mesh(model, mesh))
            numbers.append(self._numbers[key])
        return np.array(numbers, dtype=np.int_)

    def _append(self, mesh: dict[str, npt.NDArray[np.generic]]) -> None:
        if not self.arrays:
            self.arrays = {name: values[:0] for name, values in mesh.items()}
        sizes = {name: len(values) for name, values in self.arrays.items()}
        offsets = {
            "mesh_vertadr": sizes["mesh_vert"],
            "mesh_polyadr": sizes["mesh_polynormal"],
            "mesh_graphadr": sizes["mesh_graph"],
            **{address: sizes[target] for address, target in _TARGETS.items()},
        }
        for name, values in mesh.items():
            shifted = values + offsets[name] if name in offsets else values
            self.arrays[name] = np.concatenate([self.arrays[name], shifted])


def _select_mesh(model: "mujoco.MjModel", mesh: int) -> dict[str, npt.NDArray[np.generic]]:
    """Return MuJoCo's arrays of one mesh by name; its addresses, indices into other arrays, start at zero."""
    vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
    polygons = slice(model.mesh_polyadr[mesh], model.mesh_polyadr[mesh] + model.mesh_polynum[mesh])
    arrays = {
        "mesh_vertadr": np.zeros(1, dtype=np.int32),
        "mesh_polyadr": np.zeros(1, dtype=np.int32),
        "mesh_graphadr": np.zeros(1, dtype=np.int32),
        **{name: getattr(model, name)[mesh : mesh + 1] for name in _MESH_ARRAYS},
        **{name: getattr(model, name)[vertices] for name in _VERTEX_ARRAYS},
        **{name: getattr(model, name)[polygons] for name in _POLYGON_ARRAYS},
        # The graph of a mesh's convex hull ends where that of the next mesh starts.
        "mesh_graph": model.mesh_graph[model.mesh_graphadr[mesh] : [*model.mesh_graphadr, model.nmeshgraph][mesh + 1]],
    }
    for (address, target), rows, counts in zip(
        _TARGETS.items(), (polygons, vertices), ("mesh_polyvertnum", "mesh_polymapnum"), strict=True
    ):
        starts = getattr(model, address)[rows]
        arrays[address] = starts - starts[0]
        arrays[target] = getattr(model, target)[starts[0] : starts[0] + getattr(model, counts)[rows].sum()]
    return arrays


# The numbers of an object's hulls, and of objects besides the target, are padded to multiples of these. All scenes of
# DexYCB with the grasped object only therefore have one layout, and so have those with all objects.
_HULLS, _OTHER_OBJECTS = 80, 4
# Arrays of a model in which the worlds differ.
_ROW_FIELDS = (
    "body_ipos",
    "body_iquat",
    "body_mass",
    "body_subtreemass",
    "body_inertia",
    "body_invweight0",
    "dof_invweight0",
    "geom_dataid",
    "geom_size",
    "geom_aabb",
    "geom_rbound",
    "geom_pos",
    "geom_quat",
    "geom_friction",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
    "actuator_acc0",
)
# Fields that change when the target object is released; the suffix is for their values after the release.
_RELEASED_FIELDS, _RELEASED = ("geom_dataid", "actuator_forcerange"), "/released"
# Largest number of degrees of freedom with dense matrices: MuJoCo Warp's limit.
_MAX_DENSE = 60
# Arrays that may differ, and do not influence the simulation.
_UNUSED_FIELDS = ("dof_length",)


def is_device_available(device: str) -> bool:
    """Return whether Warp finds a device, "cpu" or "cuda"."""
    # Otherwise Warp prints the name of every kernel that it loads.
    warp.config.log_level = max(warp.config.log_level, warp.LOG_WARNING)
    warp.init()
    return device == "cpu" or bool(warp.is_cuda_available())


def load_padded_model(assets: SceneAssets, config: PhysicsConfig) -> SceneModel:
    """Compile a scene's model, padded to a layout that scenes share; raise `OptionError` if a shape is not a mesh."""
    parts = [load_object_parts(urdf) for urdf in assets.objects]
    for urdf, own in zip(assets.objects, parts, strict=True):
        if any(part.kind != "hull" for part in own):
            raise OptionError(f"{urdf}: collision shapes must be meshes with backend='warp'; use backend='threads'")
    padding = ModelPadding(
        objects=1 + _round_up(len(parts) - 1, _OTHER_OBJECTS), hulls=_round_up(max(map(len, parts)), _HULLS)
    )
    return load_scene_model(assets, config, padding=padding)


def _round_up(number: int, step: int) -> int:
    return -(-number // step) * step


@functools.lru_cache(maxsize=512)
def compute_layout(scene: SceneModel) -> tuple[object, ...]:
    """Return the layout of a scene's model: all arrays that must be equal in the worlds of one MuJoCo Warp model."""
    names = (field.name for field in dataclasses.fields(mujoco_warp.Model))
    arrays = {
        name: getattr(scene.model, name)
        for name in names
        if not name.startswith("mesh_") and name not in (*_ROW_FIELDS, *_UNUSED_FIELDS)
        if isinstance(getattr(scene.model, name, None), np.ndarray)
    }
    # The poses of geoms that never move are those of the first scene.
    fixed = (scene.model.body_weldid == 0)[scene.model.geom_bodyid]
    arrays |= {f"fixed {name}": getattr(scene.model, name)[fixed] for name in ("geom_pos", "geom_quat")}
    return tuple((name, array.shape, array.tobytes()) for name, array in arrays.items())


class WarpModel:
    """MuJoCo Warp model of a number of worlds, and the scenes of these worlds on the device.

    Args:
        scene: Padded scene model with the layout of all worlds.
        worlds: Number of worlds.
        arrays: Creator of tensors on Warp's current device.

    Attributes:
        source: MuJoCo model of `scene` with the options that MuJoCo Warp accepts.
        model: Model on the device, made of `source`.
    """

    def __init__(self, scene: SceneModel, worlds: int, arrays: ArrayFactory) -> None:
        model = copy.copy(scene.model)
        # MuJoCo Warp refuses this flag; it never resets a world.
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        # The matrices of scene models are dense. With sparse ones, rounding in a world depends on the other worlds.
        if model.nv > _MAX_DENSE:
            model.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
        self.source = model
        # MuJoCo Warp leaves out absent hulls only if arrays have at least two rows.
        self.model = mujoco_warp.put_model(model, dict.fromkeys(_ROW_FIELDS, max(worlds, 2)))
        # Version 4.0 leaves the velocity derivative of actuators out of the implicit integration of single free
        # bodies; without this list the objects are integrated like all other bodies.
        self.model.body_freeadr = warp.empty(0, dtype=int)
        self.model.opt.deterministic = int(mujoco_warp.DeterminismType.ALL)
        # Overflows raise an error instead.
        self.model.opt.warn_overflow = 0
        self._meshes = MeshPool()
        # Numbers of scenes by their values: a model that is compiled again is another object with the same values.
        self._numbers_by_hash, self._scene_numbers = dict[bytes, int](), WeakKeyDictionary[SceneModel, int]()
        # Tensors that share the memory of the model's arrays, and the values of each scene.
        self._rows = {name: warp.to_torch(getattr(self.model, name)) for name in _ROW_FIELDS}
        fields = {**self._rows, **{name + _RELEASED: self._rows[name] for name in _RELEASED_FIELDS}}
        self._scenes = {
            name: GrowableArray(arrays, tuple(rows.shape[1:]), str(rows.dtype).removeprefix("torch."))
            for name, rows in fields.items()
        }
        number, _ = self.add_scene(scene)
        numbers = arrays.full(len(self._rows["body_mass"]), number, "int64")
        self.select_scenes(numbers, arrays.zeros(len(numbers), "bool"))

    def add_scene(self, scene: SceneModel) -> tuple[int, bool]:
        """Copy a scene to the device, unless it is there already.

        Returns:
            Number of the scene, and whether arrays of the model were replaced; if so, captured CUDA graphs are invalid.
        """
        if scene in self._scene_numbers:
            return self._scene_numbers[scene], False
        n_meshes = len(self._meshes.arrays.get("mesh_vertadr", ()))
        values = self._compute_values(scene)
        key = hashlib.sha256(b"".join(array.tobytes() for array in values.values())).digest()
        if key not in self._numbers_by_hash:
            (self._numbers_by_hash[key],) = {self._scenes[name].extend(array) for name, array in values.items()}
        number = self._scene_numbers[scene] = self._numbers_by_hash[key]
        if len(self._meshes.arrays["mesh_vertadr"]) == n_meshes:
            return number, False
        for name, array in self._meshes.arrays.items():
            setattr(self.model, name, warp.array(array, dtype=getattr(self.model, name).dtype))
        # Largest numbers of vertices of a polygon, and of polygons around a vertex.
        self.model.npolygonmax = int(self._meshes.arrays["mesh_polyvertnum"].max())
        self.model.nmeshdegmax = int(self._meshes.arrays["mesh_polymapnum"].max())
        return number, True

    def select_scenes(self, numbers: AnyArray, released: AnyArray) -> None:
        """Write the model values of m scenes into rows 0 to m - 1 of the device arrays, one row for each world.

        Args:
            numbers: Numbers (m,) of the scenes, as returned by `add_scene`.
            released: Whether the target object of each world is released, (m,).
        """
        for name, rows in self._rows.items():
            if name not in _RELEASED_FIELDS:
                rows[: len(numbers)] = self._scenes[name].rows[numbers]
        self.select_released(numbers, released)

    def select_released(self, numbers: AnyArray, released: AnyArray) -> None:
        """Set whether target objects are `released` (m,) in the first m worlds, with the scenes `numbers` (m,)."""
        for name in _RELEASED_FIELDS:
            rows, own = self._rows[name], (self._scenes[key].rows[numbers] for key in (name + _RELEASED, name))
            rows[: len(numbers)] = get_namespace(rows).where(expand_mask(released, rows), *own)

    def _compute_values(self, scene: SceneModel) -> dict[str, npt.NDArray[np.generic]]:
        """Return a scene's values of the arrays in which worlds differ, by MuJoCo's names, e.g. "body_mass"."""
        model, target = scene.model, scene.objects[0]
        values = {name: getattr(model, name) for name in _ROW_FIELDS}
        first, count = model.body_geomadr[target], model.body_geomnum[target]
        values["geom_dataid"] = self._number_meshes(scene)
        for name in _RELEASED_FIELDS:
            values[name + _RELEASED] = values[name].copy()
        # The second copy of the target's hulls collides with supports.
        values["geom_dataid"][first + count // 2 : first + count] = -1
        start = scene.object_ctrl.start
        values["actuator_forcerange" + _RELEASED][start : start + OBJECT_DOF] = 0.0
        return values

    def _number_meshes(self, scene: SceneModel) -> npt.NDArray[np.int_]:
        """Return the number of each geom's mesh in the pool; -1 for absent hulls and other geoms."""
        model = scene.model
        numbers = self._meshes.add(model)[model.geom_dataid]
        absent = [model.geom(number).name.startswith(ABSENT_PREFIX) for number in range(model.ngeom)]
        return np.where((model.geom_dataid < 0) | absent, -1, numbers)
