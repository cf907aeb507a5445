"""Invented hand model with MANO's array shapes, and its pickles, which are composed of single operations."""

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


def text(value: str | bytes) -> bytes:
    """Return the operation for a Python 2 string (SHORT_BINSTRING or BINSTRING)."""
    data = value.encode() if isinstance(value, str) else value
    return b"U" + bytes([len(data)]) + data if len(data) < 256 else b"T" + len(data).to_bytes(4, "little") + data


def integer(value: int) -> bytes:
    """Return the operation for a signed integer of 32 bits (BININT)."""
    return b"J" + value.to_bytes(4, "little", signed=True)


def name(module: str, attribute: str) -> bytes:
    """Return the operation that requests an attribute of a module (GLOBAL)."""
    return f"c{module}\n{attribute}\n".encode()


def sequence(*items: bytes) -> bytes:
    """Return the operations for a tuple of these items."""
    return b"(" + b"".join(items) + b"t"


def mapping(**entries: bytes) -> bytes:
    """Return the operations for a dict with these entries."""
    return b"}(" + b"".join(text(key) + value for key, value in entries.items()) + b"u"


def array(value: Array) -> bytes:
    """Return the operations for an array as NumPy pickled it under Python 2."""
    order = "<" if value.dtype.byteorder != ">" else ">"
    minus_one = integer(-1)
    state = sequence(integer(3), text(order), b"N", b"N", b"N", minus_one, minus_one, integer(0))
    dtype = name("numpy", "dtype") + sequence(text(value.dtype.str[1:]), integer(0), integer(1)) + b"R" + state + b"b"
    fortran = value.flags.f_contiguous and not value.flags.c_contiguous
    made = sequence(name("numpy", "ndarray"), sequence(integer(0)), text("b"))
    shape = sequence(*map(integer, value.shape))
    content = text(value.tobytes(order="F" if fortran else "C"))
    parts = sequence(integer(1), shape, dtype, b"\x88" if fortran else b"\x89", content)
    return name("numpy.core.multiarray", "_reconstruct") + made + b"R" + parts + b"b"


def record(module: str, attribute: str, **state: bytes) -> bytes:
    """Return the operations for an object of a class with these attributes."""
    return name(module, attribute) + b")\x81" + mapping(**state) + b"b"


def sparse(matrix: csc_matrix, **changes: bytes) -> bytes:
    """Return the operations for a sparse matrix as SciPy pickled it under Python 2, with changed attributes."""
    state = {
        "_shape": sequence(*map(integer, matrix.shape)),
        "maxprint": integer(50),
        **{part: array(getattr(matrix, part)) for part in ("indices", "data", "indptr")},
    }
    return record("scipy.sparse.csc", "csc_matrix", **{**state, **changes})


def selection(wanted: Array) -> bytes:
    """Return the operations for shape directions as chumpy pickled them: the first ten of twenty directions."""
    everything = np.concatenate([wanted, np.full_like(wanted, 7.0)], axis=2)
    picked = np.arange(everything.size).reshape(everything.shape)[:, :, :10].ravel()
    an_empty_set = name("__builtin__", "set") + b"]\x85R"
    keeping = {"_dirty_vars": an_empty_set, "_itr": b"N"}
    return record(
        "chumpy.reordering",
        "Select",
        a=record("chumpy.ch", "Ch", x=array(everything), **keeping),
        idxs=array(picked),
        preferred_shape=sequence(*map(integer, wanted.shape)),
        **keeping,
    )


def official(content: Content, **changes: bytes) -> bytes:
    """Return a whole file like the official ones; `changes` replaces the operations of some entries."""
    entries = {"bs_style": text("lbs"), "J": array(np.zeros((16, 3)))}
    for key, value in content.items():
        entries[key] = sparse(value) if isinstance(value, csc_matrix) else array(value)
    if isinstance(content.get("shapedirs"), np.ndarray):
        entries["shapedirs"] = selection(content["shapedirs"])
    return b"\x80\x02" + mapping(**{**entries, **changes}) + b"."


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
