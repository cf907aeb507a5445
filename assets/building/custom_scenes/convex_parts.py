"""Convex parts of meshes by CoACD (Wei et al., SIGGRAPH 2022).

CoACD reports its progress only in its log, and cannot be interrupted. It therefore runs in a process of its own.
"""

import hashlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import QhullError

from handover_marl.errors import DataFormatError
from handover_marl.execution.files import shorten_text
from handover_marl.geometry.array_cache import get_cache_folder, load_cached_arrays, save_cached_arrays
from handover_marl.geometry.model_files.meshes import compute_convex_hull, select_extreme_points

Array = npt.NDArray[np.float64]

_MAX_CORNERS = 64  # of a convex part, as in HandoverSim's files
_SEARCH_OPTIONS = {"mcts_iterations": 60, "mcts_max_depth": 2, "mcts_nodes": 15}
_CACHE_KIND, _DESCRIPTION = "convex-parts", "convex parts"
_ROUND = re.compile(r"iter (\d+) ---- waiting pool: (\d+)")
_PROGRAM = """
import sys
import coacd, numpy
mesh = numpy.load("mesh.npz")
coacd.set_log_level("info")
body = coacd.Mesh(mesh["vertices"], mesh["faces"])
options = {name: int(value) for name, value in (part.split("=") for part in sys.argv[2:])}
parts = coacd.run_coacd(body, threshold=float(sys.argv[1]), seed=0, **options)
numpy.savez("parts.npz", *(numpy.asarray(points, dtype=float) for points, _ in parts))
"""


def decompose_mesh(
    mesh: trimesh.Trimesh, concavity: float, name: str, show: Callable[[str], object] | None = None
) -> tuple[trimesh.Trimesh, ...]:
    """Return the convex parts (m) of a mesh by CoACD (Wei et al., SIGGRAPH 2022), kept in the user's cache.

    Args:
        mesh: Surface (m).
        concavity: Largest concavity of a part.
        name: Name of the mesh, for errors.
        show: Function that is called with the stage of the search.

    Raises:
        DataFormatError: CoACD finds no body, or fails.
    """
    key = hashlib.sha256(repr((concavity, sorted(_SEARCH_OPTIONS.items()))).encode())
    for array in (np.round(mesh.vertices, 7), np.asarray(mesh.faces, dtype=np.int64)):
        key.update(np.ascontiguousarray(array).tobytes())
    path = get_cache_folder(_CACHE_KIND) / f"{key.hexdigest()[:24]}.npz"
    cached = load_cached_arrays(path, ("corners", "sizes"), _DESCRIPTION)
    if cached is None:
        corners = _run_coacd(mesh, concavity, name, show)
        if not corners:
            raise DataFormatError(f"{name}: CoACD finds no body in it; export a closed surface")
        cached = {"corners": np.concatenate(corners), "sizes": np.array([len(part) for part in corners])}
        save_cached_arrays(path, cached, _DESCRIPTION)
    hulls = (compute_convex_hull(part) for part in np.split(cached["corners"], np.cumsum(cached["sizes"])[:-1]))
    return tuple(trimesh.Trimesh(vertices, faces, process=False) for vertices, faces in hulls)


def _run_coacd(mesh: trimesh.Trimesh, concavity: float, name: str, show: Callable[[str], object] | None) -> list[Array]:
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "mesh.npz", vertices=mesh.vertices, faces=mesh.faces)
        options = [f"{option}={value}" for option, value in _SEARCH_OPTIONS.items()]
        _run_program(folder, [repr(concavity), *options], name, show)
        with np.load(Path(folder) / "parts.npz", allow_pickle=False) as parts:
            points = [parts[key] for key in parts.files]
    corners = []
    for part in points:
        try:
            hull = compute_convex_hull(part)[0]
            chosen = np.round(select_extreme_points(hull, _MAX_CORNERS), 6) + 0.0
            corners.append(compute_convex_hull(chosen)[0])
        except QhullError:  # a part without volume
            continue
    return corners


def _run_program(folder: str, arguments: list[str], name: str, show: Callable[[str], object] | None) -> None:
    """Run CoACD in a folder, and show the rounds of its search; raises `DataFormatError`."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    # Unbuffered (-u), so that the last line is the error if there is one.
    command, line = [sys.executable, "-u", "-c", _PROGRAM, *arguments], ""
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            for line in process.stdout or ():
                found = _ROUND.search(line)
                if found and show is not None:
                    show(f"round {int(found[1]) + 1} of the search, parts to divide: {found[2]}")
        except BaseException:  # Ctrl-C
            process.kill()
            raise
    if process.returncode:
        raise DataFormatError(f"{name}: CoACD fails on it ({shorten_text(line)}); export a closed surface")
