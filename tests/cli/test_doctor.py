import functools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from handover_marl.cli import main
from handover_marl.cli.installation import examine_installation
from handover_marl.datasets.asset_check import find_hand_faults
from handover_marl.datasets.dexycb.assets import write_hand_assets
from handover_marl.datasets.dexycb.mano import read_mano_model
from handover_marl.datasets.dexycb.raw_files import read_sequence_names
from handover_marl.datasets.folder_check import Finding, Severity, examine_data_folder, format_findings
from handover_marl.datasets.official_files import FileOrigin, find_hand_origin
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES, SUBJECTS
from tests.datasets.dexycb.mano_files import made_up_hand, official, write
from tests.evaluation.deadline import ends_within
from tests.unreadable import replace_by


def by_name(findings: tuple[Finding, ...]) -> dict[str, Finding]:
    return {finding.name: finding for finding in findings}


def test_missing_files_of_a_partial_folder_are_reported(fake_data: Path) -> None:
    found = by_name(examine_data_folder(fake_data))
    assert found["scenes"].severity is Severity.FAULT
    assert found["scenes"].result == "6 of 1000"
    assert "pose_000.npz" in found["scenes"].advice
    assert found["setup s0"].result.startswith("train 3 of 720, val 2 of 36")
    assert found["objects in a scene"].result == "1 in 5 scenes, 3 in 1 scene"
    assert found["grasps"].severity is Severity.FAULT
    assert "--third-party" in found["grasps"].advice
    assert found["URDFs"].severity is Severity.FAULT


def test_wrong_scene_numbers_are_reported(fake_data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    shutil.copytree(fake_data, folder, symlinks=True)
    assert by_name(examine_data_folder(folder))["numbers of scenes"].severity is Severity.NOTE, "made-up names"
    for number, rank in ((5, 5), (9, 10)):
        meta = folder / f"dex-ycb-cache/meta_{number:03d}.json"
        name = f"{SUBJECTS[0]}/{read_sequence_names()[SUBJECTS[0]][rank]}"
        meta.write_text(json.dumps({**json.loads(meta.read_text()), "name": name}))
    found = by_name(examine_data_folder(folder))["numbers of scenes"]
    assert found.severity is Severity.FAULT
    assert found.result == "1 wrong"
    assert "is scene 10, here 9" in found.advice


def test_missing_folder_is_a_fault(tmp_path: Path) -> None:
    (finding,) = examine_data_folder(tmp_path / "nothing")
    assert finding.severity is Severity.FAULT


def test_damaged_scenes_are_counted(fake_data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    shutil.copytree(fake_data, folder, symlinks=True)
    poses = [folder / f"dex-ycb-cache/pose_{scene:03d}.npz" for scene in (5, 6, 9)]
    arrays = dict(np.load(poses[0]))
    poses[0].write_bytes(poses[0].read_bytes()[:-100])
    assert by_name(examine_data_folder(folder))["scenes"].result == "5 of 1000"
    # Each damage spoils another scene.
    np.savez(poses[1], pose_y=arrays["pose_y"][:, :, :5], pose_m=arrays["pose_m"])
    np.savez(poses[2], pose_y=arrays["pose_y"], pose_m=arrays["pose_m"] * np.nan)
    metas = [folder / f"dex-ycb-cache/meta_{scene:03d}.json" for scene in (105, 204)]
    metas[0].write_text(json.dumps({**json.loads(metas[0].read_text()), "ycb_ids": [19]}))
    metas[1].write_text("{")
    assert by_name(examine_data_folder(folder))["scenes"].result == "1 of 1000"


def test_temporary_files_of_an_import_are_reported(fake_data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    shutil.copytree(fake_data, folder, symlinks=True)
    (folder / "dex-ycb-cache/.pose_010.npz.abc.part").write_bytes(b"half")
    assert by_name(examine_data_folder(folder))["leftovers"].severity is Severity.NOTE


def test_hand_origin(tmp_path: Path, fake_data: Path) -> None:
    write(tmp_path / "MANO_RIGHT.pkl", official(made_up_hand(1)))
    model = read_mano_model(tmp_path / "MANO_RIGHT.pkl", "right")
    folder = write_hand_assets(tmp_path, SUBJECTS[0], model, [0.1] * 10)
    assert find_hand_origin(folder) is FileOrigin.ORIGINAL
    mesh = folder / "meshes/collision/mesh3.obj"
    mesh.write_text(mesh.read_text() + "v 0 0 0\n")
    assert find_hand_origin(folder) is FileOrigin.STAND_IN


DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "junk": lambda path: path.write_bytes(bytes(range(256))),
    **{kind: functools.partial(replace_by, kind) for kind in ("folder", "pipe", "large")},
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_models_and_grasps_are_named(damage: str, own_data: Path) -> None:
    name = CLASS_NAMES[SCENE_CLASSES[1]]
    paths = [
        "table/table.urdf",
        "franka_panda/panda_gripper.urdf",
        f"{name}/model_normalized.urdf",
        f"grasps/{name}.npy",
        f"{name}/model_normalized_convex.obj",
        f"{name}/textured_simple.obj",
        f"{SUBJECTS[0]}_right/mano.urdf",
        f"{SUBJECTS[0]}_right/meshes/visual/mesh3.obj",
        f"{SUBJECTS[0]}_right/meshes/collision/mesh4.obj",
        "../dex-ycb-cache/pose_009.npz",
        "../dex-ycb-cache/meta_014.json",
    ]
    write(own_data / "MANO_RIGHT.pkl", official(made_up_hand(1)))
    model = read_mano_model(own_data / "MANO_RIGHT.pkl", "right")
    (own_data / "assets" / f"{SUBJECTS[0]}_right/mano.urdf").unlink()
    write_hand_assets(own_data / "assets", SUBJECTS[0], model, [0.1] * 10)
    for path in paths:
        DAMAGES[damage](own_data / "assets" / path)
    with ends_within(20.0):
        faults = [each.advice for each in examine_data_folder(own_data) if each.severity is Severity.FAULT]
    assert [path for path in paths if path.removeprefix("../") not in "".join(faults)] == []


@pytest.mark.parametrize(
    ("file", "change", "fault"),
    [
        ("mano.urdf", lambda text: text.replace('type="revolute"', 'type="fixed"', 1), "must have 51 moving joints"),
        (
            "mano.urdf",
            lambda text: text.replace("<collision>", "<visual>").replace("</collision>", "</visual>"),
            "shape",
        ),
        ("meshes/collision/mesh1.obj", lambda text: text.replace("v ", "v nan ", 1), "not finite"),
        ("meshes/visual/mesh2.obj", lambda text: text + "f 1 2 99999\n", "names a corner"),
    ],
)
def test_faults_of_a_hand(file: str, change: Callable[[str], str], fault: str, tmp_path: Path) -> None:
    write(tmp_path / "MANO_RIGHT.pkl", official(made_up_hand(1)))
    folder = write_hand_assets(tmp_path, SUBJECTS[0], read_mano_model(tmp_path / "MANO_RIGHT.pkl", "right"), [0.1] * 10)
    assert find_hand_faults(folder) == []
    (folder / file).write_text(change((folder / file).read_text()))
    (found,) = find_hand_faults(folder)
    assert fault in found
    assert str(folder) in found


def test_real_data_are_complete(real_data: Path) -> None:
    found = by_name(examine_data_folder(real_data))
    assert not [finding for finding in found.values() if finding.severity is Severity.FAULT]
    assert found["scenes"].result == "1000 of 1000"
    assert found["setup s2"].result == "train 449, val 91, test 360"
    assert found["hands"].result == "20 stand-ins"
    assert found["numbers of scenes"].result == "1000 as in DexYCB"
    assert found["grasps"].result == "19 equal to the known ones"


def test_text_fits_a_terminal() -> None:
    text = format_findings([Finding("a thing", "word " * 50, Severity.FAULT, "/a/long/path" * 4 + " do this " * 20)])
    assert max(len(line) for line in text.splitlines()) <= 100
    assert text.startswith("fault a thing")


def test_installation() -> None:
    found = by_name(examine_installation())
    assert found["packages"].severity is Severity.GOOD
    assert "numpy" in found["packages"].result
    assert {"extra train", "extra planning", "extra import"} <= set(found)


def test_a_folder_that_hides_the_library_is_reported(tmp_path: Path) -> None:
    found = {}
    for name in ("handover_marl", "handover-marl"):
        (tmp_path / name).symlink_to(Path(__file__).parents[2])
        command = [sys.executable, "-c", "from handover_marl.cli import main; main(['doctor'])"]
        elsewhere = {**os.environ, "PYTHONPATH": str(tmp_path / name)}
        run = subprocess.run(command, cwd=tmp_path, env=elsewhere, capture_output=True, text=True, check=True)
        found[name] = " ".join(run.stdout.split())
    assert "import the folder handover_marl instead of the library" in found["handover_marl"]
    assert "rename it, for example to handover-marl" in found["handover_marl"]
    assert "instead of the library" not in found["handover-marl"]


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
