"""Tests of the rank correlation between simulation and another study."""

from pathlib import Path

import pytest

from experiments.rank_correlation import Args, main
from handover_marl.errors import OptionError


def test_published_rates_are_correlated_with_a_study(tmp_path: Path) -> None:
    study = tmp_path / "study.csv"
    study.write_text("OMG Planner,80\nYang et al.,70\nGA-DDPG hold,60\nsomething else,1\n")
    text = main(Args(str(study)))
    assert "Spearman +0.50, Kendall +0.33, 3 receivers. By chance as good or better: 50.0 % of all orders" in text
    assert "64.58" in text


def test_unusable_studies_are_refused(tmp_path: Path) -> None:
    study = tmp_path / "study.csv"
    for text, why in (("OMG Planner,80\nYang et al.\n", "row 2"), ("OMG Planner,80\n", "Three or more")):
        study.write_text(text)
        with pytest.raises(OptionError, match=why):
            main(Args(str(study)))
