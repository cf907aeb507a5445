"""Invented hand model with MANO's array shapes, and its pickles."""

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix

from handover_marl.datasets.dexycb.mano import N_FACES, N_JOINTS, N_VERTICES, PARENTS, ManoModel

Array = npt.NDArray[Any]
Content = dict[str, Any]


def made_up_hand(seed: int = 0) -> Content:
    """Return the content of a model file as arrays.

    Every vertex has the weight 1 for one joint, and every triangle joins three vertices with successive numbers.
    """
    rng = np.random.default_rng(seed)
    owner = np.arange(N_VERTICES) * N_JOINTS // N_VERTICES
    whole = np.flatnonzero(owner[:-2] == owner[2:])
    corners = whole[np.arange(N_FACES) % len(whole)]
    regressor = np.where(rng.random((N_JOINTS, N_VERTICES)) < 0.03, rng.random((N_JOINTS, N_VERTICES)) / 20, 0.0)
    return {
        "v_template": rng.uniform(-0.1, 0.1, (N_VERTICES, 3)),
        "shapedirs": rng.uniform(-0.01, 0.01, (N_VERTICES, 3, 10)),
        "J_regressor": csc_matrix(regressor),
        "weights": np.eye(N_JOINTS)[owner],
        "f": np.stack([corners, corners + 1, corners + 2], axis=1).astype(np.uint32),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(N_JOINTS)], dtype=np.int64),
        "hands_components": rng.uniform(-0.4, 0.4, (45, 45)),
        "hands_mean": rng.uniform(-0.1, 0.1, 45),
    }


def made_up_model(side: str = "right", seed: int = 0) -> ManoModel:
    """Return the model of a file with the content of `made_up_hand`."""
    content = made_up_hand(seed)
    return ManoModel(
        side=side,
        v_template=content["v_template"],
        shapedirs=content["shapedirs"],
        j_regressor=content["J_regressor"].toarray(),
        weights=content["weights"],
        faces=content["f"].astype(np.int64),
        hands_components=content["hands_components"],
        hands_mean=content["hands_mean"],
    )


class Record:
    """Object that is pickled as an instance of a class that is not installed.

    Args:
        module: Module of the class.
        name: Name of the class.
        state: Attributes of the object.
    """

    def __init__(self, module: str, name: str, **state: Any) -> None:
        self.made = (f"{module}\n{name}\n".encode(), state)


class _Pickler(pickle._Pickler):  # type: ignore[name-defined,misc]
    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        """Write an object; for a `Record`, the operations GLOBAL, EMPTY_TUPLE, NEWOBJ and BUILD with its state."""
        if not isinstance(obj, Record):
            super().save(obj, save_persistent_id)
            return
        name, state = obj.made
        self.write(b"c" + name + b")\x81")
        super().save(state)
        self.write(b"b")


def sparse(matrix: csc_matrix, **changes: Array) -> Record:
    """Return a sparse matrix as older versions of SciPy pickled it, with changed attributes."""
    arrays = {part: getattr(matrix, part) for part in ("indices", "data", "indptr")}
    return Record("scipy.sparse.csc", "csc_matrix", _shape=matrix.shape, maxprint=50, **{**arrays, **changes})


def official(content: Content, **changes: object) -> bytes:
    """Return a whole file like the official ones; `changes` replaces some entries.

    The shape directions are the first ten of twenty, as chumpy pickles them, with a set that only chumpy needs.
    """
    entries = {"bs_style": "lbs", "J": np.zeros((16, 3)), **content}
    entries["J_regressor"] = sparse(content["J_regressor"])
    wanted = content["shapedirs"]
    everything = np.concatenate([wanted, np.full_like(wanted, 7.0)], axis=2)
    entries["shapedirs"] = Record(
        "chumpy.reordering",
        "Select",
        a=Record("chumpy.ch", "Ch", x=everything, _dirty_vars=set()),
        idxs=np.arange(everything.size).reshape(everything.shape)[:, :, :10].ravel(),
        preferred_shape=wanted.shape,
        _dirty_vars=set(),
    )
    stream = io.BytesIO()
    _Pickler(stream, protocol=2).dump({**entries, **changes})
    return stream.getvalue()


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
