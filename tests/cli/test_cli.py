import subprocess
import sys
from pathlib import Path

import pytest

from handover_marl.cli import main
from handover_marl.cli.options import parse_scenes
from handover_marl.errors import OptionError
from handover_marl.evaluation import episode_runner


def test_benchmark_and_evaluate(fake_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["benchmark", "--setup", "s0", "--split", "val", "--receiver", "hold", "--scenes", "9"]
    assert main([*command, "--data-dir", str(fake_data), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    assert "1 of 36 scenes (partial)" in printed.out
    assert "timeout" in printed.err
    assert main(["evaluate", str(tmp_path / "out")]) == 0
    text, report = printed.out.rstrip("\n").rsplit("\n\n", 1)
    assert capsys.readouterr().out == f"{text}\n\nPage not saved; add --out FILE.html.\n"
    assert report == f"Report: {tmp_path / 'out' / 'report.html'}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["benchmark", "--dataset", "dexycb"], "HANDOVER_MARL_DATA"),
        (["benchmark", "--data-dir", "/nowhere"], "/nowhere does not exist"),
        (["benchmark", "--setup", "s9"], "unknown setup 's9'; valid: s0, s1, s2, s3"),
        (
            ["benchmark", "--scenes", "1,x"],
            "--scenes must be numbers separated by spaces or commas, such as 209,214, got '1,x'",
        ),
        (["benchmark", "--workers", "0"], "workers must be an integer of at least 1, got 0"),
        (["benchmark", "--receiver", "nobody"], "unknown receiver 'nobody'; valid: gaddpg, hold"),
        (["pair", "--giver", "nobody"], "unknown giver 'nobody'; valid: cooperative"),
        (["crossplay", "--givers", "replay,nobody"], "unknown giver 'nobody'"),
        (["agreement", "--physics", "nuclear", "--scenes", "1"], "scene 1 is not in s0 val"),
        (["evaluate", "/nowhere"], "/nowhere does not exist"),
    ],
)
def test_error_messages(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert "Traceback" not in printed.err
    assert not printed.out


def test_ctrl_c(fake_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(episode_runner, "play", interrupted)
    assert main(["benchmark", "--split", "val", "--scenes", "9", "--data-dir", str(fake_data)]) == 130
    assert "same command resumes" in capsys.readouterr().err


@pytest.mark.slow
def test_closed_output(fake_data: Path) -> None:
    code = "import sys; from handover_marl.cli import main; sys.exit(main())"
    arguments = [
        "benchmark",
        "--split",
        "val",
        "--receiver",
        "hold",
        "--scenes",
        "9",
        "--data-dir",
        str(fake_data),
    ]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.close()
    assert "Traceback" not in process.communicate()[1]
    assert process.returncode == 141


def test_pair_selects_split_and_scenes(fake_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["pair", "--giver", "hesitant", "--receiver", "hold", "--scenes", "9", "--physics", "fast"]
    command += ["--data-dir", str(fake_data), "--out", str(tmp_path / "out"), "--workers", "1", "--no-progress"]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "s0 val, 1 of 36 scenes (partial). Receiver hold, giver hesitant, fast physics" in printed.out
    assert not printed.err
    assert main(command) == 0
    assert "1 of the 1 episodes come from an earlier run." in capsys.readouterr().out
    assert main([*command, "--seed", "1"]) == 2
    assert "another evaluation (seed '0' in the folder, '1' now)" in capsys.readouterr().err
    assert main([*command, "--seed", "1", "--fresh"]) == 0
    assert "earlier run" not in capsys.readouterr().out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("handover-marl ")


def test_parse_scenes() -> None:
    assert parse_scenes(None) is None
    assert parse_scenes(("209,", "214")) == parse_scenes(("209,214",)) == parse_scenes(("209", "214")) == [209, 214]
    for text in ("", "1,", "a", "1.5"):
        with pytest.raises(OptionError):
            parse_scenes((text,))
