"""What stands in for HandoverSim's third-party archive where a user has only DexYCB's own object models.

Convex parts are cut from the models by CoACD (Wei et al., SIGGRAPH 2022), grasps are the library's, made for objects
of the same outer dimensions, and the Panda is PyBullet's. Every such file says so, and so does every result on it.
"""

import functools
import io
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import QhullError

from handover_marl.assets.robot_model import PANDA_URDF, panda_text
from handover_marl.assets.shipped_grasps import load_object_grasps
from handover_marl.datasets.importing.asset_files import put_files
from handover_marl.datasets.official_files import PANDA_FILES, STAND_IN
from handover_marl.errors import DataFormatError
from handover_marl.models.hulls import extreme_points, hull
from handover_marl.models.obj_files import read_obj
from handover_marl.models.panda import PANDA_CAMERA
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.working import worked_on

Array = npt.NDArray[np.float64]

# As HandoverSim's own parts: at most so many corners, more than Bullet is quick with.
_MOST_CORNERS = 64
# CoACD's measure of how far the parts may be from the mesh; its authors' default.
_CONCAVITY = 0.05
# Less search than its authors' default, which takes longer for parts that are hardly better.
_SEARCH = {"mcts_iterations": 60, "mcts_max_depth": 2, "mcts_nodes": 15}
_LARGEST_MODEL = 100_000_000  # bytes; DexYCB's have a few million
_SHOWN = ("textured_simple.obj", "textured_simple.obj.mtl", "texture_map.png")
_COLLISION = "model_normalized_convex.obj"
_PANDA_MESHES = "stand_in"


def write_stand_ins(models: Path, assets: Path, workers: int, progress: bool) -> list[str]:
    """Write what is missing as far as DexYCB's models allow; faults, a sentence each.

    Nothing is done for a user who has no models.

    Args:
        models: DexYCB's folder of object models.
        assets: HandoverSim's folder `assets`.
        workers: Processes.
        progress: Whether to show a progress bar on stderr.

    Raises:
        ResultsError: A file cannot be written.
    """
    if not models.is_dir():
        return []
    faults = copy_models(models, assets)
    faults += _cut(assets, classes_without_parts(assets), workers, progress)
    write_grasps(assets)
    write_panda(assets)
    return faults


def _cut(assets: Path, names: list[str], workers: int, progress: bool) -> list[str]:
    if not names:
        return []
    if find_spec("coacd") is None:
        return [
            f"{len(names)} objects such as {names[0]} have no convex parts: give HandoverSim's third-party archive "
            "(--third-party), which has the original ones, or install what cuts them (pip install "
            "'handover-marl[import]')"
        ]
    cut = worked_on(lambda: functools.partial(_cut_one, assets), names, "convex parts", PoolConfig(workers), progress)
    return [fault for _, fault in cut if fault]


def _cut_one(assets: Path, name: str) -> str:
    try:
        put_files(assets, {f"{name}/{_COLLISION}": convex_parts(assets / name / _SHOWN[0]).encode()})
    except DataFormatError as error:
        return str(error)
    return ""


def copy_models(models: Path, assets: Path) -> list[str]:
    """Copy what DexYCB's `models/` has of the archive's files: the objects' looks. Faults, a sentence each.

    Raises:
        ResultsError: A file cannot be written.
    """
    faults = []
    for name in CLASS_NAMES.values():
        for file in _SHOWN:
            source = models / name / file
            if source.is_file() and not (assets / name / file).exists():
                if source.stat().st_size > _LARGEST_MODEL:
                    faults.append(f"{source} has more than {_LARGEST_MODEL // 1_000_000} MB; copy it again")
                    continue
                put_files(assets, {f"{name}/{file}": source.read_bytes()})
    return faults


def classes_without_parts(assets: Path) -> list[str]:
    """Objects that have a model to cut, but no convex parts."""
    return [
        name
        for name in CLASS_NAMES.values()
        if (assets / name / _SHOWN[0]).is_file() and not (assets / name / _COLLISION).exists()
    ]


def convex_parts(model: Path) -> str:
    """The text of an OBJ file with the convex parts of another, an object each.

    Raises:
        DataFormatError: The model is no mesh.
    """
    import coacd  # type: ignore[import-untyped]

    mesh = read_obj(model)
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces),
        threshold=_CONCAVITY,
        seed=0,
        **_SEARCH,
    )
    if not parts:
        raise DataFormatError(f"{model}: CoACD finds no body in it; copy DexYCB's models again")
    texts, first = [f"# {STAND_IN}: convex parts by CoACD\n"], 1
    for number, (points, _) in enumerate(parts):
        try:
            corners = _few_corners(np.asarray(points, dtype=np.float64))
        except QhullError:  # a part without volume
            continue
        texts.append(_part_text(number, corners, first))
        first += len(corners)
    return "".join(texts)


def _part_text(number: int, corners: Array, first: int) -> str:
    lines = [f"o convex_{number}", *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in corners)]
    lines += [f"f {a} {b} {c}" for a, b, c in hull(corners)[1] + first]
    return "\n".join(lines) + "\n"


def _few_corners(points: Array) -> Array:
    """The corners of a part, rounded; CoACD's own way to fewer ones cuts millimetres off."""
    return hull(np.round(extreme_points(hull(points)[0], _MOST_CORNERS), 6) + 0.0)[0]


def write_grasps(assets: Path) -> None:
    """Write the library's grasps for classes that lack a grasp file.

    Raises:
        ResultsError: A file cannot be written.
    """
    for name in CLASS_NAMES.values():
        path, grasps = f"grasps/{name}.npy", load_object_grasps(name)
        if grasps is not None and not (assets / path).exists():
            stream = io.BytesIO()
            np.save(stream, np.array({b"source": STAND_IN.encode(), b"transforms": grasps}), allow_pickle=True)
            put_files(assets, {path: stream.getvalue()})


def write_panda(assets: Path) -> None:
    """Write PyBullet's Panda where there is none.

    Raises:
        ResultsError: A file cannot be written.
    """
    lacking = [robot for robot, path in PANDA_FILES.items() if not (assets / path).exists()]
    if not lacking:
        return
    meshes = {
        f"franka_panda/{_PANDA_MESHES}/{file.relative_to(PANDA_URDF.parent).as_posix()}": file.read_bytes()
        for file in sorted((PANDA_URDF.parent / "meshes").rglob("*"))
        if file.is_file()
    }
    put_files(assets, meshes)
    for robot in lacking:
        text = panda_text(f"package://{_PANDA_MESHES}", camera=robot == PANDA_CAMERA)
        put_files(assets, {PANDA_FILES[robot]: f"<!-- {STAND_IN}: PyBullet's Panda -->\n{text}".encode()})
