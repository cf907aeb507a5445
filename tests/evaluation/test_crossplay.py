import csv
import io
from pathlib import Path

import pytest
from PIL import Image

import handover_marl
from handover_marl.cli import main
from handover_marl.errors import OptionError, UnknownNameError

SCENES = "9"


@pytest.mark.slow
def test_command_writes_tables_and_a_picture(
    fake_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "cross"
    command = ["crossplay", "--givers", "replay, hesitant", "--receivers", "hold", "--scenes", SCENES]
    command += ["--data-dir", str(fake_data), "--physics", "fast", "--workers", "1", "--out", str(out)]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert "Cross-play on s0 val, 1 of 36 scenes" in text
    assert "fast physics" in text
    assert (out / "crossplay.md").read_text().startswith("# Cross-play")
    rows = list(csv.DictReader(io.StringIO((out / "crossplay.csv").read_text())))
    assert [(row["giver"], row["receiver"], row["n_episodes"]) for row in rows] == [
        ("replay", "hold", "1"),
        ("hesitant", "hold", "1"),
    ]
    assert rows[0]["timeout"] == "1.000000"
    with Image.open(out / "crossplay.png") as picture:
        assert picture.width > 300
    assert (out / "hesitant-hold" / "000.npz").is_file()


def test_unknown_names_are_reported_before_the_first_scene(fake_data: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="receiver 'nobody'"):
        handover_marl.crossplay(["replay"], ["hold", "nobody"], data_dir=fake_data, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    for givers in ([], None, 5):
        with pytest.raises(OptionError, match="givers must name at least one giver, got"):
            handover_marl.crossplay(givers, ["hold"], data_dir=fake_data)  # type: ignore[arg-type]
