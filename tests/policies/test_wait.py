"""Tests of the time that receivers wait before they move."""

from typing import Any

import numpy as np
import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import OptionError
from handover_marl.policies.reference import parse_policy
from handover_marl.receivers import Receiver

DATA = SyntheticDataset()


class Patient(Receiver):
    name = "patient"
    seconds: Any = 2.0

    def reset(self, seed: int | None = None) -> None:
        pass

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return observation["robot_joint_position"]

    @property
    def wait(self) -> Any:
        return self.seconds


class Hasty(Patient):
    seconds = -1.0


@pytest.mark.parametrize(
    ("receiver", "wait"),
    [
        ("yang2021", 3.0),
        ("yang2021:wait=0", 0.0),
        ("omg", 3.0),
        ("omg_hand_aware:wait=1.5", 1.5),
        ("hold", None),
        ("random", 0.0),
        (Patient, 2.0),
    ],
)
def test_receivers_tell_their_wait(receiver: Any, wait: float | None) -> None:
    if isinstance(receiver, str) and receiver.startswith("omg"):
        pytest.importorskip("igl", reason="needs the extra `planning`")
    assert parse_policy("receiver", receiver).resolve(DATA).wait == wait


def test_impossible_waits_are_refused() -> None:
    with pytest.raises(OptionError, match=r"wait must be a time from 0 to 60 s, got -1\.0"):
        parse_policy("receiver", Hasty).resolve(DATA)
    with pytest.raises(OptionError, match="wait must be a time from 0 to 60 s, got 99"):
        parse_policy("receiver", "yang2021:wait=99").resolve(DATA)


def test_a_wait_is_waited() -> None:
    """Yang's receiver does not move before the end of its waiting time."""
    from handover_marl.episode.episode import Episode
    from handover_marl.episode.loop import ActionRecorder, run_episode

    episode, first = Episode("fast"), {}
    for wait in (0.0, 0.7):
        episode.reset(DATA.load_scene(9))
        log = ActionRecorder()
        run_episode(
            episode, parse_policy("receiver", ("yang2021", {"wait": wait})).make(DATA), until=900, callbacks=[log]
        )
        moves = np.flatnonzero((log.actions != log.actions[0]).any(axis=1))
        first[wait] = int(moves[0])
    assert first[0.0] < 700 <= first[0.7]
    episode.close()
