"""Tests of the context of givers, of waiting times, and of numbers of a configuration as options."""

import re
from typing import Any

import numpy as np
import pytest

from handover_marl.config import WorldConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import ActionRecorder, run_episode
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.givers import Giver, make_policy_context
from handover_marl.givers.variations import ReplayGiver
from handover_marl.policies.policy import override_options
from handover_marl.policies.reference import PolicyLike, parse_policy
from handover_marl.receivers.baselines import HoldReceiver
from handover_marl.receivers.reactive.config import ReactiveConfig

DATA = SyntheticDataset()


class Plain(ReplayGiver):
    name = "plain"


class Alone(Plain):
    """Giver whose constructor takes no context."""

    name = "alone"

    def __init__(self) -> None:
        super().__init__()


class Hasty(HoldReceiver):
    name = "hasty"

    @property
    def wait(self) -> Any:
        return -1.0


@pytest.mark.parametrize("policy", [Plain, ("tired", {"sinking": 0.02}), "replay", "cooperative"])
def test_classes_and_names_get_the_context(policy: PolicyLike) -> None:
    made = parse_policy("giver", policy).make(DATA, WorldConfig(), "s2")
    assert made.context.setup == "s2"
    assert made.context.find_object_urdf("025_mug").is_file()


def test_givers_work_without_a_context() -> None:
    for made in (parse_policy("giver", Alone).make(DATA), parse_policy("giver", Plain()).make(DATA), Plain()):
        made.reset()
        assert isinstance(made, Giver)
        with pytest.raises(OptionError, match=r"context must be given to the constructor of (Alone|Plain), got none"):
            _ = made.context
    context = make_policy_context(DATA)
    assert Plain(context).context is context


@pytest.mark.parametrize(
    ("receiver", "wait"),
    [
        *(("yang2021", 3.0), ("yang2021:wait=0", 0.0), ("omg_hand_aware:wait=1.5", 1.5)),
        *(("hold", None), ("population", None)),
    ],
)
def test_receivers_tell_their_wait(receiver: str, wait: float | None) -> None:
    if receiver.startswith("omg"):
        pytest.importorskip("igl", reason="needs the extra `planning`")
    assert parse_policy("receiver", receiver).resolve(DATA).wait == wait


def test_impossible_waits_are_refused() -> None:
    for receiver, wait in ((Hasty, r"-1\.0"), ("yang2021:wait=99", "99")):
        with pytest.raises(OptionError, match=f"wait must be a time from 0 to 60 s, got {wait}"):
            parse_policy("receiver", receiver).resolve(DATA)


@pytest.mark.slow
def test_a_wait_is_waited() -> None:
    """Yang's receiver does not move before the end of its waiting time."""
    episode, first = Episode("fast"), {}
    for wait in (0.0, 0.7):
        episode.reset(DATA.load_scene(9))
        log, receiver = ActionRecorder(), parse_policy("receiver", ("yang2021", {"wait": wait})).make(DATA)
        run_episode(episode, receiver, until=900, callbacks=[log])
        first[wait] = int(np.flatnonzero((log.actions != log.actions[0]).any(axis=1))[0])
    assert first[0.0] < 700 <= first[0.7]
    episode.close()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("standof", 0.1, "unknown option 'standof'"),
        ("approach", 0.1, "unknown option 'approach'"),
        ("approach_standof", 0.1, "did you mean 'approach_standoff'?"),
        ("approach_standoff", "far", "approach_standoff must be a finite float, got 'far'"),
        ("approach_standoff", float("nan"), "must be a finite float, got nan"),
        ("selection_max_candidates", 2.5, "must be a finite int, got 2.5"),
    ],
)
def test_invalid_options(name: str, value: object, message: str) -> None:
    with pytest.raises((OptionError, UnknownNameError), match=re.escape(message)):
        override_options(ReactiveConfig(), {name: value})
