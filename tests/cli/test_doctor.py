"""Tests of the command `doctor`, which collects the errors of the readers that evaluations use."""

from pathlib import Path

import numpy as np
import pytest

from handover_marl.cli import main
from handover_marl.cli.folders import check_data_folder, check_installation
from handover_marl.datasets.dexycb.assets import write_hand_assets
from handover_marl.datasets.dexycb.mano import read_mano_model
from handover_marl.datasets.official_files import FileOrigin, find_hand_origin
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES, SUBJECTS
from tests.datasets.dexycb.raw_files import made_up_hand, official, write


@pytest.mark.slow
def test_faults_are_listed(own_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poses = [own_data / f"dex-ycb-cache/pose_{scene:03d}.npz" for scene in (5, 6)]
    poses[0].write_bytes(poses[0].read_bytes()[:-100])
    np.savez(poses[1], **dict(np.load(poses[1])) | {"pose_m": np.zeros(3)})
    (level, name, text), *models = check_data_folder(own_data)
    assert (level, name) == ("fault", "scenes")
    assert text.startswith(f"4 of 1000 in {own_data}")
    assert "meta_000.json does not exist" in text
    assert text.endswith("and 976 more")
    assert {name for _, name, _ in models} == {"models"}
    monkeypatch.setattr("handover_marl.cli.folders._MAX_LISTED", 2000)
    damaged = f"grasps/{CLASS_NAMES[3]}.npy", f"{CLASS_NAMES[SCENE_CLASSES[1]]}/model_normalized.urdf"
    for path in damaged:
        (own_data / "assets" / path).write_bytes(bytes(range(256)))
    (_, _, text), *_ = check_data_folder(own_data)
    for path in damaged:
        assert path in text


def test_hand_origin(tmp_path: Path, fake_data: Path) -> None:
    write(tmp_path / "MANO_RIGHT.pkl", official(made_up_hand(1)))
    model = read_mano_model(tmp_path / "MANO_RIGHT.pkl", "right")
    folder = write_hand_assets(tmp_path, SUBJECTS[0], model, [0.1] * 10)
    assert find_hand_origin(folder) is FileOrigin.ORIGINAL
    mesh = folder / "meshes/collision/mesh3.obj"
    mesh.write_text(mesh.read_text() + "v 0 0 0\n")
    assert find_hand_origin(folder) is FileOrigin.STAND_IN


def test_installation() -> None:
    found = {name: level for level, name, _ in check_installation()}
    assert found["physics"] == "ok"
    assert {"extra train", "extra planning", "extra import"} <= set(found)


@pytest.mark.slow
def test_command_and_exit_status(
    fake_data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HANDOVER_MARL_DATA", raising=False)
    assert main(["doctor"]) == 0
    assert "synthetic scenes" in capsys.readouterr().out
    assert main(["doctor", "--data-dir", str(fake_data), "--no-progress"]) == 1
    assert "6 of 1000" in capsys.readouterr().out
    monkeypatch.setenv("HANDOVER_MARL_DATA", str(fake_data / "nothing"))
    assert main(["doctor"]) == 1
