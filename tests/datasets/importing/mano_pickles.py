"""Reading MANO's pickles for the integration test; only what they name may be made, and chumpy's parts stay inert."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from handover_marl.datasets.importing.mano_model import ManoModel


class _Record:
    """Keeps the state of an object of chumpy or of SciPy."""

    state: dict[str, Any]

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.state = state


_ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy.core.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("__builtin__", "set"): set,
    ("chumpy.ch", "Ch"): _Record,
    ("chumpy.reordering", "Select"): _Record,
    ("scipy.sparse.csc", "csc_matrix"): _Record,
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        return _ADMITTED[module, name]


def load_hand(path: Path, side: str) -> ManoModel:
    """The hand in a MANO pickle."""
    with path.open("rb") as stream:
        content = _Unpickler(stream, encoding="latin1").load()
    chosen, regressor = content["shapedirs"].state, content["J_regressor"].state
    parents = content["kintree_table"][0].astype(np.int64)
    parents[0] = -1
    return ManoModel(
        side=side,
        v_template=np.asarray(content["v_template"]),
        shapedirs=chosen["a"].state["x"].ravel()[chosen["idxs"]].reshape(chosen["preferred_shape"]),
        j_regressor=scipy.sparse.csc_matrix(
            (regressor["data"], regressor["indices"], regressor["indptr"]), shape=regressor["_shape"]
        ),
        weights=np.asarray(content["weights"]),
        faces=content["f"].astype(np.int64),
        parents=parents,
        hands_components=np.asarray(content["hands_components"]),
        hands_mean=np.asarray(content["hands_mean"]),
    )
