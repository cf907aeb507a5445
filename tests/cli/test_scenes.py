"""Tests of the commands `handover-marl scenes ...`."""

from pathlib import Path

import numpy as np
import pytest

from handover_marl.cli import main
from handover_marl.datasets.custom.scene_file import read_scene_file
from tests.helpers.custom_scenes import make_box, make_recording, write_csv

MUG = ("add-motion", "mine", "motion.csv", "--object", "025_mug", "--subject", "a")
OBJECT = ("--grasps", "0", "--concavity", "1", "--no-progress")


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    box = make_box()
    box.apply_scale(1000.0)
    box.export("box.stl")
    recording = make_recording()
    recording["object"][:, 2] -= 0.92
    write_csv(tmp_path / "motion.csv", {key: recording[key] for key in ("time", "object")})
    return tmp_path


@pytest.mark.slow
def test_commands_build_a_folder(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "add-object", "mine", "box", "box.stl", "--unit", "mm", "--mass", "0.2", *OBJECT]) == 0
    printed = capsys.readouterr().out
    assert "object box: class 22, 0.2 kg, friction 0.9; 0 grasps held" in printed
    assert "the gripper opens 80 mm" in printed
    for person, frame in (("anna", "0,0,0.92,0,0,0,1"), ("ben", "table")):
        motion = ["scenes", "add-motion", "mine", "motion.csv", "--object", "box", "--subject", person]
        assert main([*motion, "--frame", frame, "--hand", "none"]) == 0
    with np.load(work / "mine" / "motion" / "000000.npz") as arrays:
        np.testing.assert_allclose(arrays["object_dof"][0, 0, 2], 0.92 + 0.081, atol=1e-5)
    assert "scene ben/000001: box; no hand" in capsys.readouterr().out
    assert main(["scenes", "add-split", "mine", "people", "--by", "person", "--val", "ben", "--test", "0"]) == 0
    assert main(["scenes", "add-split", "mine", "none", "--by", "person", "--val", "0,"]) == 2
    assert "'0'" in capsys.readouterr().err
    assert main(["scenes", "check", "mine"]) == 0
    output = capsys.readouterr().out
    assert "own data: mine, 2 scenes" in output
    assert "setup people: train 1, val 1, test 0" in output
    content = read_scene_file(work / "mine")
    assert content.setups["people"] == {"train": (0,), "val": (1,), "test": ()}
    assert main(["scenes", "preview", "mine", "1", "--out", "scene.png", "--no-progress"]) == 0
    assert (work / "scene.png").stat().st_size > 1000


@pytest.mark.slow
def test_preview_of_a_refused_recording(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra `plot`")
    assert main(["scenes", *MUG, "--time", "us", "--hand", "none", "--preview", "refused.png"]) == 2
    assert "a motion must last" in capsys.readouterr().err
    assert main(["scenes", *MUG, "--hand", "none", "--preview", "refused.png"]) == 2
    assert "object must start above the table" in capsys.readouterr().err
    assert (work / "refused.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["add-object", "mine", "box", "box.stl", *OBJECT], "unit='mm'"),
        ([*MUG, "--frame", "1,2"], "frame must be"),
        ([*MUG, "--hand", "12"], "hand"),
        (["check", "mine"], "is no folder of custom scenes"),
    ],
)
def test_errors_are_one_message(
    work: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(["scenes", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (work / "mine").exists()
