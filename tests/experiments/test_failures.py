"""experiments/analysis/failures.py finds the causes of failures of any receiver."""

import pytest

from tests.learning.training.scripts import script
from tests.short_episodes import shorten_episodes


def _printed(
    receiver: str, scenes: tuple[int, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    failures = script("failures", monkeypatch)
    failures.main(failures.Args(dataset="synthetic", scenes=scenes, receiver=receiver))
    return capsys.readouterr().out


def test_receiver_that_never_moves_ends_with_open_fingers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shorten_episodes(monkeypatch, 1500)
    printed = _printed("hold", (9,), monkeypatch, capsys)
    assert "synthetic, s0 val, 1 episodes, giver replay, receiver hold, panda, fast physics, camera perfect" in printed
    assert "| timeout with open fingers | 1        | 100.0 |" in printed


def test_contacts_name_the_phase(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    printed = _printed("yang2021", (14, 64), monkeypatch, capsys)
    assert "| contact of panda_leftfinger with open fingers | 1        | 50.0 |" in printed
    assert "| contact of panda_leftfinger while closing     | 1        | 50.0 |" in printed
