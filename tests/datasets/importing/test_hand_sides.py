from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.importing.hand_sides import doubts_about_sides
from handover_marl.datasets.importing.import_dexycb import import_dexycb
from handover_marl.datasets.importing.mano_model import ManoModel, read_mano_model
from tests.datasets.importing.mano_files import Content, made_up_hand, official, write
from tests.datasets.importing.raw_files import RawScene


def right_hand(reach: float = -0.08) -> Content:
    """A made-up hand whose index finger begins `reach` m along x from the wrist."""
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


def test_files_under_their_own_names(tmp_path: Path) -> None:
    assert doubts_about_sides(*models(tmp_path, right_hand(), mirrored(right_hand()))) == []


def test_exchanged_files(tmp_path: Path) -> None:
    (doubt,) = doubts_about_sides(*models(tmp_path, mirrored(right_hand()), right_hand()))
    assert "MANO_RIGHT.pkl seems to hold the left hand" in doubt
    assert "exchange their names" in doubt


def test_one_file_under_both_names(tmp_path: Path) -> None:
    (doubt,) = doubts_about_sides(*models(tmp_path, right_hand(), right_hand()))
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
def test_nothing_is_said_of_hands_that_are_not_manos(tmp_path: Path, right: Content, left: Content) -> None:
    assert doubts_about_sides(*models(tmp_path, right, left)) == []


def test_an_import_says_so(tmp_path: Path) -> None:
    RawScene(name="20200709_141754").write(tmp_path / "raw")
    models(tmp_path / "mano", mirrored(right_hand()), right_hand())
    found = import_dexycb(tmp_path / "raw", tmp_path / "mano", tmp_path / "out", workers=1, progress=False)
    assert "exchange their names" in str(found)
