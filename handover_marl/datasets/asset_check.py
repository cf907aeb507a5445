"""Search for missing and damaged models and grasps in a data folder, with the readers that simulations use."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from handover_marl.config import HAND_DOF, OBJECT_DOF, PANDA_DOF
from handover_marl.datasets.grasp_files import load_grasps
from handover_marl.datasets.official_files import N_HAND_MESHES, PANDA_FILES
from handover_marl.errors import HandoverError
from handover_marl.execution.reading import read_plain_file
from handover_marl.geometry.model_files.meshes import check_model
from handover_marl.geometry.model_files.obj_files import check_mesh
from handover_marl.geometry.model_files.urdf import list_mesh_references
from handover_marl.geometry.ycb import CLASS_NAMES

#: Paths in `assets/` of the objects' URDFs.
OBJECT_URDFS = tuple(f"{name}/model_normalized.urdf" for name in CLASS_NAMES.values())
# Moving joints of the models that every data folder needs.
_N_JOINTS = {
    "table/table.urdf": 0,
    **dict.fromkeys(PANDA_FILES.values(), PANDA_DOF),
    **dict.fromkeys(OBJECT_URDFS, OBJECT_DOF),
}


def is_hand_complete(folder: Path) -> bool:
    """Return whether the URDF and all meshes of a hand exist."""
    return all(path.exists() for path in (folder / "mano.urdf", *_list_hand_meshes(folder)))


def find_hand_faults(folder: Path) -> list[str]:
    """Return descriptions of the damaged files of a complete hand."""
    faults = _find_faults(partial(check_model, n_joints=HAND_DOF), [folder / "mano.urdf"])
    # The meshes of a damaged URDF are unknown, those of a hand are not.
    faults += _find_faults(check_mesh, _list_hand_meshes(folder))
    return list(dict.fromkeys(faults))


def read_asset(assets: Path, path: str) -> tuple[bytes, list[str]]:
    """Read a third-party file and check that simulations can read it, too.

    Args:
        assets: Folder `assets/` of the data folder.
        path: Path of the file in `assets/`.

    Returns:
        Content, empty if it cannot be read, and descriptions of faults, at most one.

    Raises:
        FileNotFoundError, NotADirectoryError: The file is missing.
    """
    file = assets / path
    checks: dict[str, Callable[[Path], object]] = {".npy": load_grasps, ".obj": check_mesh}
    check = checks.get(file.suffix)
    try:
        content = read_plain_file(file)
    except (FileNotFoundError, NotADirectoryError):
        raise
    except (OSError, ValueError) as error:
        return b"", [f"{file} cannot be read ({error})"]
    return content, _find_faults(check, [file]) if check else []


def find_urdf_faults(assets: Path) -> list[str]:
    """Return descriptions of missing and damaged URDFs of objects, table and robots, and of their meshes."""
    faults = []
    for path, n_joints in sorted(_N_JOINTS.items()):
        urdf = assets / path
        try:
            # HandoverSim's URDFs name the camera's body at a path that does not exist.
            meshes = {name: mesh for name, mesh in list_mesh_references(urdf) if "camera" not in name}
        except (FileNotFoundError, NotADirectoryError):
            faults.append(f"{path} is missing")
            continue
        except (OSError, ValueError) as error:
            faults.append(f"{urdf} cannot be read ({error})")
            continue
        missing = [f"{path} names {name}, which is missing" for name, mesh in meshes.items() if not mesh.exists()]
        faults += missing or _find_faults(partial(check_model, n_joints=n_joints), [urdf])
    return faults


def _list_hand_meshes(folder: Path) -> list[Path]:
    numbers = range(1, N_HAND_MESHES + 1)
    return [folder / "meshes" / kind / f"mesh{n}.obj" for kind in ("visual", "collision") for n in numbers]


def _find_faults(check: Callable[[Path], object], paths: Iterable[Path]) -> list[str]:
    faults = []
    for path in paths:
        try:
            check(path)
        except HandoverError as error:
            faults.append(str(error))
    return faults
