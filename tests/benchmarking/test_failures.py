"""experiments/failures.py tells of any receiver why it failed."""

import pytest

from tests.training.scripts import script


def _told(
    receiver: str, scenes: tuple[int, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    failures = script("failures", monkeypatch)
    failures.main(failures.Args(dataset="synthetic", scenes=scenes, receiver=receiver))
    return capsys.readouterr().out


def test_who_never_moves_ends_with_open_fingers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = _told("hold", (9,), monkeypatch, capsys)
    assert "synthetic, s0 val, 1 episodes, giver replay, receiver hold, panda, fast physics, camera perfect" in told
    assert "| timeout with open fingers | 1        | 100.0 |" in told


def test_contacts_tell_what_the_fingers_did(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = _told("yang2021", (14, 64), monkeypatch, capsys)
    assert "| contact of panda_leftfinger with open fingers   | 1        | 50.0 |" in told
    assert "| contact of panda_leftfinger once it was closing | 1        | 50.0 |" in told
