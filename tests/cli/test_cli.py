"""Tests of the command line, and of the command `doctor`, which collects the errors of readers."""

import importlib
import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from handover_marl.cli import main
from handover_marl.cli.folders import check_data_folder, check_installation
from handover_marl.cli.options import PairArguments, ReceiverArguments, RenderArguments, SceneArguments
from handover_marl.datasets.dexycb.assets import write_hand_assets
from handover_marl.datasets.dexycb.mano import read_mano_model
from handover_marl.datasets.official import FileOrigin, find_hand_origin
from handover_marl.evaluation import episode_runner
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.execution.options import is_installed
from handover_marl.geometry.model_files.obj_files import format_obj
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES, SUBJECTS
from handover_marl.policies.registry import import_reference
from tests.datasets.dexycb.raw_files import made_up_hand, official, write
from tests.evaluation.quick import write_results
from tests.helpers.short_episodes import shorten_episodes

PROGRAM = "import sys; from handover_marl.cli import main; sys.exit(main())"


@pytest.mark.parametrize("arguments", [PairArguments, ReceiverArguments, SceneArguments, RenderArguments])
def test_defaults_of_commands_are_those_of_the_configuration(arguments: type[PairArguments]) -> None:
    assert EvaluationConfig(**arguments().get_fields()) == EvaluationConfig()


@pytest.mark.slow
def test_benchmark_and_report(
    fake_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 100)
    command = ["benchmark", "--setup", "s0", "--split", "val", "--receiver", "hold", "--scenes", "9"]
    assert main([*command, "--data-dir", str(fake_data), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    assert "1 of 36 scenes (partial)" in printed.out
    assert "timeout" in printed.err
    assert main(["report", str(tmp_path / "out")]) == 0
    text, report = printed.out.rstrip("\n").rsplit("\n\n", 1)
    assert capsys.readouterr().out == f"{text}\n\nPage not saved; add --out FILE.html.\n"
    assert report == f"Report: {tmp_path / 'out' / 'report.html'}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["benchmark", "--dataset", "dexycb"], "HANDOVER_MARL_DATA"),
        (["benchmark", "--data-dir", "/nowhere"], "/nowhere does not exist"),
        (["benchmark", "--data-dir", __file__], "test_cli.py is a file, not a folder"),
        (["benchmark", "--receiver", "nobody"], "unknown receiver 'nobody'; valid: dagger, gaddpg"),
        (["evaluate-pair", "--physics", "nuclear"], "unknown physics 'nuclear'; valid: exact"),
        (["report", "/nowhere"], "/nowhere does not exist"),
        (["benchmark", "--out", ""], "out must be a path, got '' (it is empty)"),
    ],
)
def test_error_messages(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert "Traceback" not in printed.err
    assert not printed.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--workers", "two"], "--workers: must be a whole number, got 'two'"),
        (["--initial-joint-noise", "5deg"], "must be a number, got '5deg'"),
        (["--inference-time", "fast"], "must be a number or measured, got 'fast'"),
        (["--scenes", "first"], "such as 209,214, got 'first'"),
    ],
)
def test_messages_for_numbers(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["evaluate-pair", *arguments])
    assert message in " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_ctrl_c(fake_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(episode_runner, "run_episode", interrupted)
    assert main(["benchmark", "--split", "val", "--scenes", "9", "--data-dir", str(fake_data)]) == 130
    assert "same command without --overwrite resumes" in capsys.readouterr().err


@pytest.mark.slow
def test_closed_output(tmp_path: Path) -> None:
    """A reader may close the output of a command before its end."""
    command = [sys.executable, "-c", PROGRAM, "report", str(write_results(tmp_path / "out"))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.close()
    assert "Traceback" not in process.communicate()[1]
    assert process.returncode == 141


@pytest.mark.slow
def test_streams_that_are_closed_at_the_start(fake_data: Path, tmp_path: Path) -> None:
    # Python runs this file when it starts, also in worker processes.
    shorten = "import pytest, tests.helpers.short_episodes as short; short.shorten_episodes(pytest.MonkeyPatch(), 100)"
    (tmp_path / "sitecustomize.py").write_text(shorten)
    env = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(__file__).parents[2]}"}
    command = [sys.executable, "-c", PROGRAM, "evaluate-pair", "--receiver", "hold", "--scenes", "9", "14"]
    command += ["--physics", "fast", "--workers", "2", "--data-dir", str(fake_data), "--out", str(tmp_path / "out")]
    assert subprocess.run(f"{shlex.join(command)} >&- 2>&-", shell=True, check=False, env=env).returncode == 0
    assert len(list((tmp_path / "out").glob("0*.npz"))) == 2


@pytest.mark.slow
def test_pair_selects_split_and_scenes(
    fake_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 100)
    command = ["evaluate-pair", "--giver", "hesitant", "--receiver", "hold", "--scenes", "9", "--physics", "fast"]
    command += ["--data-dir", str(fake_data), "--out", str(tmp_path / "out"), "--workers", "1", "--no-progress"]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "s0 val, 1 of 36 scenes (partial). Receiver hold, giver hesitant, fast physics" in printed.out
    assert not printed.err
    assert main(command) == 0
    assert "1 of the 1 episodes come from an earlier run." in capsys.readouterr().out
    assert main([*command, "--seed", "1"]) == 2
    assert "another evaluation (seed '0' in the folder, '1' now)" in capsys.readouterr().err
    assert main([*command, "--seed", "1", "--overwrite"]) == 0
    assert "earlier run" not in capsys.readouterr().out
    assert main([*command, "--seed", "1", "--initial-joint-noise", "0.1"]) == 2
    assert "world 'official' in the folder, 'initial_joint_noise=0.1' now" in capsys.readouterr().err


def test_version_and_help(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "3")  # as in a window of three columns, in which texts cannot be wrapped
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("handover-marl ")
    with pytest.raises(SystemExit):
        main(["evaluate-pair", "--help"])
    assert "--receiver" in capsys.readouterr().out


def test_modules_of_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Policies are imported from the working folder, but folders there do not count as optional packages."""
    (tmp_path / "robots.py").write_text("from handover_marl.receivers.baselines import HoldReceiver as Mine\n")
    (tmp_path / "minari").mkdir()
    (tmp_path / "minari" / "__init__.py").touch()
    # Other tests may have imported it.
    monkeypatch.delitem(sys.modules, "minari", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    importlib.invalidate_caches()
    assert not is_installed("minari")
    assert import_reference("receiver", "robots:Mine").name == "hold"


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
    closed = trimesh.creation.box((0.1, 0.1, 0.1))
    (folder / "meshes/visual/mesh1.obj").write_text(format_obj(np.array(closed.vertices), np.array(closed.faces)))
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
