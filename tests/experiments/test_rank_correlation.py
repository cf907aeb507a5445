"""Tests of the rank correlation between simulation and another study."""

from pathlib import Path

from experiments.rank_correlation import Args, main


def test_published_rates_are_correlated_with_a_study(tmp_path: Path) -> None:
    study = tmp_path / "study.csv"
    study.write_text("OMG Planner,80\nYang et al.,70\nGA-DDPG hold,60\nsomething else,1\n")
    text = main(Args(str(study)))
    assert "Spearman +0.50, Kendall +0.33, 3 receivers. By chance as good or better: 50.0 % of all orders" in text
    assert "64.58" in text
