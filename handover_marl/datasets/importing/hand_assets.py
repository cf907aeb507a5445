"""The hands' models: what HandoverSim makes of MANO for one person and side."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.importing.asset_files import put_files
from handover_marl.datasets.importing.hand_urdf import hand_urdf
from handover_marl.datasets.importing.mano_model import N_JOINTS, ManoModel
from handover_marl.errors import DataFormatError, UnknownNameError
from handover_marl.models.ycb import SUBJECTS

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]

# A body has the vertices that go with its joint by more than this.
_SHARE = 0.2
# Neighbouring fingers would touch at their roots, so these bodies collide with less than they show.
_SHARE_AT_ROOTS = 0.7
_ROOTS = (4, 7, 10)  # of the middle, the little and the ring finger


def hand_files(model: ManoModel, betas: Sequence[float] | Array) -> dict[str, bytes]:
    """The 33 files of a hand's model, by path relative to its folder: `mano.urdf` and `meshes/<kind>/mesh1..16.obj`.

    Args:
        model: MANO's hand of that side.
        betas: (10,) numbers that describe the person's hand.

    Raises:
        OptionError: The betas are not ten finite numbers of a plausible size.
        DataFormatError: The model leaves a body without a triangle.
    """
    vertices = model.shaped_vertices(betas)
    joints = model.joints(vertices)
    files = {"mano.urdf": hand_urdf(joints).encode()}
    for kind in ("visual", "collision"):
        for joint in range(N_JOINTS):
            share = _SHARE_AT_ROOTS if kind == "collision" and joint in _ROOTS else _SHARE
            corners, faces = _body(model, vertices, joint, share)
            files[f"meshes/{kind}/mesh{joint + 1}.obj"] = obj_text(corners - joints[joint], faces).encode()
    return files


def write_hand_assets(assets: Path, subject: str, model: ManoModel, betas: Sequence[float] | Array) -> Path:
    """Write a hand's model to `<subject>_<side>/`, and return that folder.

    Args:
        assets: HandoverSim's folder `assets`.
        subject: The person, e.g. "20200709-subject-01".
        model: MANO's hand of the side to write.
        betas: (10,) numbers that describe the person's hand; HandoverSim takes those of the person's first scene for
            both sides.

    Raises:
        UnknownNameError: DexYCB has no such person.
        OptionError, DataFormatError: As `hand_files`.
        ResultsError: A file is there with other content, or cannot be written.
    """
    if subject not in SUBJECTS:
        raise UnknownNameError("subject", subject, SUBJECTS)
    folder = assets / f"{subject}_{model.side}"
    put_files(folder, hand_files(model, betas))
    return folder


def obj_text(vertices: Array, faces: Faces) -> str:
    """A mesh as Wavefront OBJ, in micrometre steps.

    Unlike those of `assets/building`, the numbers keep trailing zeros and the sign of zero, as the official ones do.

    Args:
        vertices: (v, 3), m.
        faces: (f, 3) vertices of each triangle, from 0.
    """
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist()]
    return "".join(lines)


def _body(model: ManoModel, vertices: Array, joint: int, share: float) -> tuple[Array, Faces]:
    """Vertices (v, 3) and triangles (f, 3) that belong to a joint, in the model's order and not yet moved."""
    kept = model.weights[:, joint] > share
    faces = model.faces[kept[model.faces].all(axis=1)]
    if not len(faces):
        raise DataFormatError(
            f"MANO's {model.side} hand has no triangle of joint {joint} by its weights; take the model file from the "
            "original mano_v1_2.zip"
        )
    renumbered = np.cumsum(kept) - 1
    return vertices[kept], renumbered[faces]
