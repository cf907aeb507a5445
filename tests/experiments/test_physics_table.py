"""The table of receivers in all kinds of physics, on a generated scene."""

from pathlib import Path

import pytest

from tests.learning.training.scripts import script
from tests.short_episodes import shorten_episodes


def test_the_table_lists_the_evaluated_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra `plot`")
    shorten_episodes(monkeypatch, 1000)
    make = script("physics_table", monkeypatch)
    args = make.Args(
        receivers=("hold",),
        giver="hurried",
        physics=("exact", "fast"),
        stride=36,
        dataset="synthetic",
        workers=1,
        out=tmp_path / "out",
    )
    reported = make.main(args).read_text()
    assert "s0 val, 1 episodes each, giver hurried, synthetic scenes" in reported
    assert "| hold     | 0.0 (0.0 to 79.3) | 0.0 (0.0 to 79.3) | 100.0 (20.7 to 100.0) |" in reported
    assert (tmp_path / "out" / "physics.png").stat().st_size > 5_000
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"hold-exact", "hold-fast"}
