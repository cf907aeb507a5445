"""experiments/rank_correlation.py, as one would call it."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).parents[2] / "experiments" / "rank_correlation.py"


def reported(study: Path, text: str) -> subprocess.CompletedProcess[str]:
    study.write_text(text)
    return subprocess.run(
        [sys.executable, str(SCRIPT), "--real", str(study)], capture_output=True, text=True, check=False
    )


def test_published_rates_are_correlated_with_a_study(tmp_path: Path) -> None:
    found = reported(tmp_path / "study.csv", "OMG Planner,80\nYang et al.,70\nGA-DDPG hold,60\nsomething else,1\n")
    assert found.returncode == 0, found.stderr
    assert "Spearman +0.50, Kendall +0.33, 3 receivers" in found.stdout
    assert "64.58" in found.stdout


def test_errors_name_the_line_of_the_study(tmp_path: Path) -> None:
    for text, why in (("OMG Planner,80\nYang et al.\n", "line 2"), ("OMG Planner,80\n", "Three or more")):
        found = reported(tmp_path / "study.csv", text)
        assert found.returncode == 1
        assert why in found.stderr
        assert "Traceback" not in found.stderr
