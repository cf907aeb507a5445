import pickle
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csc_array, csc_matrix

from handover_marl.datasets.dexycb.importer import import_dexycb
from handover_marl.datasets.dexycb.mano import N_FACES, N_JOINTS, PARENTS, ManoModel, check_hand_sides, read_mano_model
from handover_marl.errors import DataFormatError, DataNotFoundError, OptionError, UnknownNameError
from tests.datasets.dexycb.mano_files import (
    Content,
    array,
    integer,
    made_up_hand,
    official,
    record,
    saved_with_chumpy,
    selection,
    sequence,
    sparse,
    text,
    write,
)
from tests.datasets.dexycb.raw_files import RawScene, hand_model

HAND = made_up_hand()


def read(folder: Path, data: bytes, side: str = "right") -> ManoModel:
    return read_mano_model(write(folder / "MANO_RIGHT.pkl", data), side)


def assert_is(model: ManoModel, content: Content) -> None:
    for key in ("v_template", "shapedirs", "weights", "hands_components", "hands_mean"):
        found = getattr(model, key)
        assert (found.dtype, found.dtype.isnative, found.flags.writeable) == (np.float64, True, False)
        np.testing.assert_array_equal(found, content[key])
    np.testing.assert_array_equal(model.j_regressor.toarray(), content["J_regressor"].toarray())
    assert model.j_regressor.dtype == np.float64
    np.testing.assert_array_equal(model.faces, content["f"])
    assert model.faces.dtype == np.int64


@pytest.mark.parametrize("side", ["right", "left"])
def test_reads_official_files(tmp_path: Path, side: str) -> None:
    model = read(tmp_path, official(HAND), side)
    assert model.side == side
    assert_is(model, HAND)


@pytest.mark.parametrize(
    "changes",
    [
        {"f": array(np.asfortranarray(HAND["f"]))},
        {"f": array(HAND["f"].astype(np.int64))},
        {"weights": array(HAND["weights"].astype(">f8"))},
        {"kintree_table": array(np.array([PARENTS, range(N_JOINTS)]))},
        {"kintree_table": array(np.array([PARENTS, range(N_JOINTS)]).astype(np.uint64))},
        {"shapedirs": array(HAND["shapedirs"])},
        {"shapedirs": record("chumpy.ch", "Ch", x=array(HAND["shapedirs"]))},
        {"J_regressor": array(HAND["J_regressor"].toarray())},
        {"J_regressor": array(HAND["J_regressor"].toarray().astype(">f8"))},
        {"J_regressor": sparse(HAND["J_regressor"], data=array(HAND["J_regressor"].data.astype(">f8")))},
        {"J_regressor": sparse(HAND["J_regressor"], data=array(np.append(HAND["J_regressor"].data, 7.0)))},
        {"posedirs": integer(0)},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_reads_variants(tmp_path: Path, changes: dict[str, bytes]) -> None:
    assert_is(read(tmp_path, official(HAND, **changes)), HAND)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("make", [csc_matrix, csc_array, lambda matrix: matrix.toarray()])
def test_reads_files_of_current_libraries(tmp_path: Path, protocol: int, make: Any) -> None:
    data = pickle.dumps({**HAND, "J_regressor": make(HAND["J_regressor"])}, protocol=protocol)
    assert_is(read(tmp_path, data), HAND)


@pytest.fixture
def chumpy(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    """Return empty classes with the names of chumpy's, for writing files; reading must not need them."""
    found = {}
    for module, attribute in (("chumpy.ch", "Ch"), ("chumpy.reordering", "Select")):
        made = types.ModuleType(module)
        found[attribute] = type(attribute, (), {"__module__": module})
        setattr(made, attribute, found[attribute])
        monkeypatch.setitem(sys.modules, module, made)
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    return types.SimpleNamespace(**found)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_reads_chumpy_objects_of_any_protocol(
    tmp_path: Path, chumpy: types.SimpleNamespace, protocol: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = saved_with_chumpy(HAND, chumpy, protocol)
    monkeypatch.undo()
    assert_is(read(tmp_path, data), HAND)


def test_vertices_and_joints(tmp_path: Path) -> None:
    model = read(tmp_path, official(HAND))
    betas = np.linspace(-1.5, 2.0, 10)
    vertices = model.shape_vertices(betas)
    np.testing.assert_allclose(vertices, HAND["v_template"] + HAND["shapedirs"] @ betas, atol=1e-15)
    np.testing.assert_array_equal(model.shape_vertices(betas.tolist()), vertices)
    np.testing.assert_allclose(model.regress_joints(vertices), HAND["J_regressor"].toarray() @ vertices, atol=1e-15)


def test_sums_round_after_every_operation(tmp_path: Path) -> None:
    model = read(tmp_path, official(HAND))
    betas = [0.1 * number - 0.4 for number in range(10)]
    vertices, dense = model.shape_vertices(betas), HAND["J_regressor"].toarray()
    for vertex in range(0, 778, 97):
        moved = 0.0
        for number in range(10):
            moved = moved + float(HAND["shapedirs"][vertex, 1, number]) * betas[number]
        assert vertices[vertex, 1] == float(HAND["v_template"][vertex, 1]) + moved
    for joint in range(N_JOINTS):
        total = 0.0
        for vertex in np.flatnonzero(dense[joint]):
            total = total + float(dense[joint, vertex]) * float(vertices[vertex, 2])
        assert model.regress_joints(vertices)[joint, 2] == total


@pytest.mark.parametrize("betas", [[0.0] * 9, [0.0] * 9 + [np.nan], [[0.0] * 10], ["x"] * 10, None, [1e9] * 10])
def test_wrong_betas(tmp_path: Path, betas: Any) -> None:
    with pytest.raises(OptionError, match="10 finite numbers"):
        read(tmp_path, official(HAND)).shape_vertices(betas)


def test_wrong_vertices(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="778"):
        read(tmp_path, official(HAND)).regress_joints(np.zeros((777, 3)))


def changed(key: str, index: Any, value: float) -> dict[str, bytes]:
    spoilt = np.array(HAND[key])
    spoilt[index] = value
    return {key: array(spoilt)}


REGRESSOR = HAND["J_regressor"]
WRONG = {
    "v_template too short": ({"v_template": array(HAND["v_template"][:-1])}, "v_template must have shape"),
    "v_template in mm": ({"v_template": array(HAND["v_template"] * 1000)}, "beyond 1"),
    "v_template rounded": ({"v_template": array(HAND["v_template"].astype(np.float32))}, "float64, found float32"),
    "v_template of integers": ({"v_template": array(np.zeros((778, 3), dtype=np.int64))}, "float64, found int64"),
    "v_template is text": ({"v_template": text("hand")}, "v_template is no array"),
    "v_template is sparse": ({"v_template": sparse(csc_matrix(HAND["v_template"]))}, "found a sparse matrix"),
    "v_template is no variable": ({"v_template": record("chumpy.ch", "Ch", y=integer(1))}, "v_template is no array"),
    "shapedirs with all twenty": ({"shapedirs": array(np.zeros((778, 3, 20)))}, "shapedirs must have shape"),
    "shapedirs picks too far": (
        {"shapedirs": selection(HAND["shapedirs"], idxs=array(np.full(23340, 46680)))},
        "do not exist",
    ),
    "shapedirs picks backwards": (
        {"shapedirs": selection(HAND["shapedirs"], idxs=array(np.full(23340, -1)))},
        "out of range",
    ),
    "shapedirs picks by floats": (
        {"shapedirs": selection(HAND["shapedirs"], idxs=array(np.zeros(23340)))},
        "list of integers",
    ),
    "shapedirs without a shape": ({"shapedirs": selection(HAND["shapedirs"], preferred_shape=b"N")}, "lacks its shape"),
    "shapedirs of odd shape": (
        {"shapedirs": selection(HAND["shapedirs"], preferred_shape=sequence(integer(778), text("3")))},
        "impossible shape",
    ),
    "shapedirs of another size": (
        {"shapedirs": selection(HAND["shapedirs"], preferred_shape=sequence(integer(778), integer(3)))},
        "do not exist",
    ),
    "shapedirs of a selection": (
        {"shapedirs": selection(HAND["shapedirs"], a=selection(HAND["shapedirs"]))},
        "shapedirs is no array",
    ),
    "weights not a number": (changed("weights", (3, 3), np.nan), "not finite"),
    "weights infinite": (changed("weights", (3, 3), np.inf), "not finite"),
    "hands_mean in degrees": (changed("hands_mean", 3, 180.0), "beyond 100"),
    "f names a vertex too many": (changed("f", (3, 0), 778), "a vertex that does not exist"),
    "f of floats": ({"f": array(HAND["f"].astype(np.float64))}, "f must be integers"),
    "f too short": ({"f": array(HAND["f"][: N_FACES - 1])}, "f must be integers"),
    "another tree": (changed("kintree_table", (0, 4), 3), "not the tree"),
    "joints in another order": (changed("kintree_table", (1, 4), 3), "not the tree"),
    "J_regressor with a row too many": (
        {"J_regressor": sparse(REGRESSOR, indices=array(np.full(REGRESSOR.nnz, 16)))},
        "row that does not exist",
    ),
    "J_regressor with a negative row": (
        {"J_regressor": sparse(REGRESSOR, indices=array(np.full(REGRESSOR.nnz, -1)))},
        "out of range",
    ),
    "J_regressor that runs back": (
        {"J_regressor": sparse(REGRESSOR, indptr=array(np.where(np.arange(779) == 400, 0, REGRESSOR.indptr)))},
        "no proper columns",
    ),
    "J_regressor that lacks elements": (
        {"J_regressor": sparse(REGRESSOR, data=array(REGRESSOR.data[:-1]))},
        "lacks elements",
    ),
    "J_regressor without data": ({"J_regressor": sparse(REGRESSOR, data=b"N")}, "J_regressor is no array"),
    "J_regressor far too large": (
        {"J_regressor": sparse(REGRESSOR, _shape=sequence(integer(2**30), integer(778)))},
        "impossible shape",
    ),
    "J_regressor of another shape": ({"J_regressor": sparse(csc_matrix(np.eye(16)))}, "must have shape"),
    "J_regressor rounded": ({"J_regressor": sparse(REGRESSOR.astype(np.float32))}, "float64"),
    "J_regressor not finite": ({"J_regressor": sparse(REGRESSOR * np.nan)}, "not finite"),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_content_is_named(tmp_path: Path, what: str) -> None:
    changes, message = WRONG[what]
    with pytest.raises(DataFormatError, match=rf"MANO_RIGHT\.pkl.*{message}.*mano_v1_2\.zip"):
        read(tmp_path, official(HAND, **changes))


def test_missing_keys_are_named(tmp_path: Path) -> None:
    short = {key: value for key, value in HAND.items() if key not in ("weights", "f")}
    with pytest.raises(DataFormatError, match="it lacks weights, f"):
        read(tmp_path, official(short))


def test_missing_files_and_folders(tmp_path: Path) -> None:
    with pytest.raises(DataNotFoundError, match=r"nothing\.pkl.*mano_v1_2\.zip"):
        read_mano_model(tmp_path / "nothing.pkl", "right")
    with pytest.raises(DataFormatError, match="not a plain file"):
        read_mano_model(tmp_path, "right")
    with pytest.raises(UnknownNameError, match="both"):
        read_mano_model(tmp_path / "nothing.pkl", "both")


BETAS = st.lists(st.floats(-3.0, 3.0), min_size=10, max_size=10)


@given(betas=BETAS)
def test_shape_and_joints(betas: list[float]) -> None:
    model = hand_model()
    vertices = model.shape_vertices(betas)
    np.testing.assert_allclose(vertices, model.v_template + model.shapedirs @ betas, atol=1e-12)
    joints = model.regress_joints(vertices)
    np.testing.assert_allclose(joints, model.j_regressor @ vertices, atol=1e-12)
    np.testing.assert_array_equal(model.locate_wrist(betas), joints[0])


def test_finger_pose_sums_are_from_left_to_right() -> None:
    model = hand_model()
    shapedirs = np.zeros_like(model.shapedirs)
    shapedirs[0, 0] = [1.0, 2.0**-53, 2.0**-53, 0, 0, 0, 0, 0, 0, 0]
    regressor = scipy.sparse.lil_matrix((16, 778))
    regressor[3, 5], regressor[3, 6], regressor[3, 7] = 1.0, 2.0**-53, 2.0**-53
    model = replace(model, shapedirs=shapedirs, j_regressor=regressor.tocsc(), v_template=np.zeros((778, 3)))
    # Summed from right to left, the two small numbers together would change the sum.
    assert model.shape_vertices([1.0] * 10)[0, 0] == 1.0
    assert model.regress_joints(np.ones((778, 3)))[3, 0] == 1.0


def test_mean_hand() -> None:
    model = hand_model()
    np.testing.assert_array_equal(model.shape_vertices([0] * 10), model.v_template)


def right_hand(reach: float = -0.08) -> Content:
    """Return an invented hand whose index finger begins `reach` m along x from the wrist."""
    content = made_up_hand()
    regressor = np.zeros((16, 778))
    regressor[np.arange(16), np.arange(16)] = 1.0
    content["J_regressor"] = regressor
    content["v_template"][0, 0], content["v_template"][1, 0] = 0.09, 0.09 + reach
    return content


def mirrored(content: Content) -> Content:
    return {**content, "v_template": content["v_template"] * [-1.0, 1.0, 1.0]}


def models(folder: Path, right: Content, left: Content) -> tuple[ManoModel, ManoModel]:
    folder.mkdir(exist_ok=True)
    paths = [
        write(folder / f"MANO_{name}.pkl", official(content)) for name, content in (("RIGHT", right), ("LEFT", left))
    ]
    return read_mano_model(paths[0], "right"), read_mano_model(paths[1], "left")


def test_correct_files(tmp_path: Path) -> None:
    assert check_hand_sides(*models(tmp_path, right_hand(), mirrored(right_hand()))) == []


def test_exchanged_files(tmp_path: Path) -> None:
    (doubt,) = check_hand_sides(*models(tmp_path, mirrored(right_hand()), right_hand()))
    assert "MANO_RIGHT.pkl seems to hold the left hand" in doubt
    assert "exchange their names" in doubt


def test_equal_files(tmp_path: Path) -> None:
    (doubt,) = check_hand_sides(*models(tmp_path, right_hand(), right_hand()))
    assert "hold the same hand" in doubt


@pytest.mark.parametrize(
    ("right", "left"),
    [
        (made_up_hand(0), made_up_hand(1)),
        (mirrored(right_hand()), made_up_hand(1)),
        (mirrored(right_hand()), right_hand(-0.082)),
        (right_hand(0.02), mirrored(right_hand(0.02))),
    ],
    ids=["two strangers", "no twins", "nearly twins", "fingers that hardly point anywhere"],
)
def test_unknown_hands_are_not_checked(tmp_path: Path, right: Content, left: Content) -> None:
    assert check_hand_sides(*models(tmp_path, right, left)) == []


def test_import_reports_exchanged_files(tmp_path: Path) -> None:
    RawScene(name="20200709_141754").write(tmp_path / "raw")
    models(tmp_path / "mano", mirrored(right_hand()), right_hand())
    found = import_dexycb(tmp_path / "raw", tmp_path / "mano", tmp_path / "out", workers=1, progress=False)
    assert "exchange their names" in str(found)
