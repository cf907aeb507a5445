"""experiments/nudged_outcomes.py tells how many episodes end otherwise with targets a little beside."""

import pytest

from tests.training.scripts import script


def test_no_nudge_changes_nothing_and_a_large_one_does(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    nudged = script("nudged_outcomes", monkeypatch)
    nudged.main(nudged.Args(dataset="synthetic", split="val", stride=12, nudges=(1e-9, 0.3), physics="fast", workers=1))
    told = capsys.readouterr().out
    assert "s0 val, 3 episodes each, receiver yang2021, giver replay, synthetic, fast physics" in told
    rows = {line.split("|")[1].strip(): line.split("|")[2] for line in told.splitlines() if line.startswith("|")}
    assert rows["0"].strip().startswith("100.0")
    assert rows["1e-09"].strip().startswith("100.0")
    assert not rows["0.3"].strip().startswith("100.0")
