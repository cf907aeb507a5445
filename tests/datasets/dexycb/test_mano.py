import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csc_array, csc_matrix

from handover_marl.datasets.dexycb.mano import ManoModel, read_mano_model
from handover_marl.errors import DataFormatError
from tests.datasets.dexycb.raw_files import Content, Record, made_up_hand, official, sparse, write

HAND = made_up_hand()
REGRESSOR = HAND["J_regressor"]


def read(folder: Path, data: bytes, side: str = "right") -> ManoModel:
    return read_mano_model(write(folder / "MANO_RIGHT.pkl", data), side)


def assert_is(model: ManoModel, content: Content) -> None:
    for key in ("v_template", "shapedirs", "weights", "hands_components", "hands_mean"):
        found = getattr(model, key)
        assert (found.dtype, found.dtype.isnative, found.flags.writeable) == (np.float64, True, False)
        np.testing.assert_array_equal(found, content[key])
    np.testing.assert_array_equal(model.j_regressor, content["J_regressor"].toarray())
    np.testing.assert_array_equal(model.faces, content["f"])
    assert model.faces.dtype == np.int64


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"f": HAND["f"].astype(np.int64)},
        {"weights": HAND["weights"].astype(">f8")},
        {"shapedirs": Record("chumpy.ch", "Ch", x=HAND["shapedirs"])},
        {"J_regressor": REGRESSOR.toarray()},
    ],
)
def test_reads_official_files_and_variants(tmp_path: Path, changes: dict[str, Any]) -> None:
    model = read(tmp_path, official(HAND, **changes), "left")
    assert model.side == "left"
    assert_is(model, HAND)


@pytest.mark.parametrize("make", [csc_matrix, csc_array])
def test_reads_files_of_current_libraries(tmp_path: Path, make: Any) -> None:
    assert_is(read(tmp_path, pickle.dumps({**HAND, "J_regressor": make(REGRESSOR)})), HAND)


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"v_template": HAND["v_template"][:-1]}, "v_template must have shape"),
    ({"v_template": HAND["v_template"].astype(np.float32)}, "float64, found float32"),
    ({"weights": np.full((778, 16), np.nan)}, "not finite"),
    ({"f": HAND["f"].astype(np.float64)}, "f must be integers"),
    ({"J_regressor": sparse(REGRESSOR, indices=np.full(REGRESSOR.nnz, -1))}, ""),
]


@pytest.mark.parametrize(("changes", "message"), WRONG)
def test_wrong_content_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataFormatError, match=rf"MANO_RIGHT\.pkl.*{message}.*mano_v1_2\.zip"):
        read(tmp_path, official(HAND, **changes))


def test_a_truncated_file(tmp_path: Path) -> None:
    with pytest.raises(DataFormatError, match="not a readable MANO model"):
        read(tmp_path, official(HAND)[:-1000])
