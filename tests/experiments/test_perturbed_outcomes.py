"""experiments/analysis/perturbed_outcomes.py reports how many episodes end otherwise with targets a little beside."""

import pytest

from tests.learning.training.scripts import script


def test_only_a_large_perturbation_changes_outcomes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = script("perturbed_outcomes", monkeypatch)
    options = {"dataset": "synthetic", "split": "val", "stride": 12, "physics": "fast", "workers": 1}
    module.main(module.Args(offsets=(1e-9, 0.3), **options))
    reported = capsys.readouterr().out
    assert "s0 val, 3 episodes each, receiver yang2021, giver replay, synthetic, fast physics" in reported
    rows = {line.split("|")[1].strip(): line.split("|")[2] for line in reported.splitlines() if line.startswith("|")}
    assert rows["0"].strip().startswith("100.0")
    assert rows["1e-09"].strip().startswith("100.0")
    assert not rows["0.3"].strip().startswith("100.0")
