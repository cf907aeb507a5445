"""experiments/measure_generated.py prints stored evaluations beside those of s0."""

from pathlib import Path

import pytest

from experiments.measure_generated import Args, format_rate, main


def test_table_without_stored_results_shows_s0(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(Args(receivers=("vision", "reactive"), out=tmp_path, evaluate=False))
    text = capsys.readouterr().out
    assert text.count("DexYCB s0") >= 2
    assert "`vision`" in text
    assert "`omg`" not in text


def test_rates_have_wilson_intervals() -> None:
    assert format_rate(7, 20) == "35.0 (18.1 to 56.7)"
