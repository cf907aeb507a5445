"""What is told of data folders."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from handover_marl.cli import main
from handover_marl.datasets.importing.hand_assets import write_hand_assets
from handover_marl.datasets.importing.mano_model import read_mano_model
from handover_marl.datasets.importing.sequence_names import SEQUENCE_NAMES
from handover_marl.datasets.official_files import Origin, hand_origin
from handover_marl.doctor.data_folder import examine
from handover_marl.doctor.findings import Finding, State, findings_text
from handover_marl.doctor.installation import examine_installation
from handover_marl.models.ycb import SUBJECTS
from tests.datasets.importing.mano_files import made_up_hand, official, write


def by_name(findings: tuple[Finding, ...]) -> dict[str, Finding]:
    return {finding.what: finding for finding in findings}


def test_a_partial_folder_tells_what_is_missing(fake_data: Path) -> None:
    found = by_name(examine(fake_data))
    assert found["scenes"].state is State.FAULT
    assert found["scenes"].found == "6 of 1000"
    assert "meta_000.json" in found["scenes"].advice
    assert found["setup s0"].found.startswith("train 3 of 720, val 2 of 36")
    assert found["objects in a scene"].found == "1 in 5 scenes, 3 in 1 scene"
    assert found["grasps"].state is State.FAULT
    assert "--third-party" in found["grasps"].advice
    assert found["URDFs"].state is State.FAULT


def test_scenes_under_wrong_numbers_are_found(fake_data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    shutil.copytree(fake_data, folder, symlinks=True)
    assert by_name(examine(folder))["numbers of scenes"].state is State.NOTE, "made-up names"
    for number, rank in ((5, 5), (9, 10)):
        meta = folder / f"dex-ycb-cache/meta_{number:03d}.json"
        name = f"{SUBJECTS[0]}/{SEQUENCE_NAMES[SUBJECTS[0]][rank]}"
        meta.write_text(json.dumps({**json.loads(meta.read_text()), "name": name}))
    found = by_name(examine(folder))["numbers of scenes"]
    assert found.state is State.FAULT
    assert found.found == "1 wrong"
    assert "is scene 10, here 9" in found.advice


def test_no_folder_is_a_fault(tmp_path: Path) -> None:
    (finding,) = examine(tmp_path / "nothing")
    assert finding.state is State.FAULT


@pytest.mark.parametrize("damage", ["truncated", "other numbers", "not finite", "unknown class", "no json"])
def test_a_damaged_scene_is_found(damage: str, fake_data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    shutil.copytree(fake_data, folder, symlinks=True)
    pose, meta = folder / "dex-ycb-cache/pose_009.npz", folder / "dex-ycb-cache/meta_009.json"
    arrays = dict(np.load(pose))
    if damage == "truncated":
        pose.write_bytes(pose.read_bytes()[:-100])
    elif damage == "other numbers":
        np.savez(pose, pose_y=arrays["pose_y"][:, :, :5], pose_m=arrays["pose_m"])
    elif damage == "not finite":
        np.savez(pose, pose_y=arrays["pose_y"], pose_m=arrays["pose_m"] * np.nan)
    elif damage == "unknown class":
        meta.write_text(json.dumps({**json.loads(meta.read_text()), "ycb_ids": [19]}))
    else:
        meta.write_text("{")
    assert by_name(examine(folder))["scenes"].found == "5 of 1000"


def test_what_a_killed_import_left_is_found(fake_data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    shutil.copytree(fake_data, folder, symlinks=True)
    (folder / "dex-ycb-cache/.pose_010.npz.abc.part").write_bytes(b"half")
    assert by_name(examine(folder))["leftovers"].state is State.NOTE


def test_a_hand_compiled_from_mano_is_told_from_others(tmp_path: Path, fake_data: Path) -> None:
    write(tmp_path / "MANO_RIGHT.pkl", official(made_up_hand(1)))
    model = read_mano_model(tmp_path / "MANO_RIGHT.pkl", "right")
    folder = write_hand_assets(tmp_path, SUBJECTS[0], model, [0.1] * 10)
    assert hand_origin(folder) is Origin.ORIGINAL
    mesh = folder / "meshes/collision/mesh3.obj"
    mesh.write_text(mesh.read_text() + "v 0 0 0\n")
    assert hand_origin(folder) is Origin.STAND_IN


def test_the_real_data_are_whole(real_data: Path) -> None:
    found = by_name(examine(real_data))
    assert not [finding for finding in found.values() if finding.state is State.FAULT]
    assert found["scenes"].found == "1000 of 1000"
    assert found["setup s2"].found == "train 449, val 91, test 360"
    assert found["hands"].found == "20 stand-ins"
    assert found["numbers of scenes"].found == "1000 as in DexYCB"
    assert found["grasps"].found == "19 equal to the known ones"


def test_text_fits_a_terminal() -> None:
    text = findings_text([Finding("a thing", "word " * 50, State.FAULT, "/a/long/path" * 4 + " do this " * 20)])
    assert max(len(line) for line in text.splitlines()) <= 100
    assert text.startswith("fault a thing")


def test_the_installation() -> None:
    found = by_name(examine_installation())
    assert found["packages"].state is State.GOOD
    assert "numpy" in found["packages"].found
    assert {"extra train", "extra planning", "extra import"} <= set(found)


def test_the_command_and_its_exit_status(
    fake_data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HANDOVER_MARL_DATA", raising=False)
    assert main(["doctor"]) == 0
    assert "synthetic scenes" in capsys.readouterr().out
    assert main(["doctor", "--data-dir", str(fake_data), "--no-progress"]) == 1
    assert "6 of 1000" in capsys.readouterr().out
    monkeypatch.setenv("HANDOVER_MARL_DATA", str(fake_data / "nothing"))
    assert main(["doctor"]) == 1
