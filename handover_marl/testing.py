"""Conformance tests for your own givers and receivers; call them from your test suite.

from handover_marl.testing import check_receiver


def test_my_receiver():
check_receiver(MyReceiver)
"""

import random
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.datasets import Dataset, open_dataset
from handover_marl.episode.clock import held_steps
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.episode.play import play
from handover_marl.episode.sight import SightConfig
from handover_marl.episode.watchers import Decision, Watcher
from handover_marl.errors import ConformanceError
from handover_marl.options import pybullet_installed
from handover_marl.policies.policy import Action, Policy
from handover_marl.policies.reference import PolicyLike, policy_reference

__all__ = ["check_giver", "check_receiver"]

_SCENES = (9, 14)
_STEPS = 4000


def check_receiver(
    receiver: PolicyLike, dataset: Dataset | None = None, scenes: Sequence[int] = _SCENES, steps: int = _STEPS
) -> None:
    """Check that a receiver does what the benchmark relies on.

    It can be named and sent to worker processes; its actions are valid in whole episodes; it leaves its observations
    alone; and episodes repeat from their seed whatever was played before, in whichever process, and whatever others
    draw from global generators.

    Args:
        receiver: As in `handover_marl.benchmark`.
        dataset: Where scenes come from; default: the synthetic ones.
        scenes: The scenes to play.
        steps: How much of each to play (ms).

    Raises:
        ConformanceError: It does not; the message says where and what to do.
        HandoverError: It cannot be made, fails, or returns what is no action.
    """
    _check("receiver", receiver, dataset or open_dataset("synthetic"), scenes, steps)


def check_giver(
    giver: PolicyLike, dataset: Dataset | None = None, scenes: Sequence[int] = _SCENES, steps: int = _STEPS
) -> None:
    """Check that a giver does what cross-play relies on; as `check_receiver`, beside the receiver `yang2021`.

    Raises:
        ConformanceError, HandoverError: As `check_receiver`.
    """
    _check("giver", giver, dataset or open_dataset("synthetic"), scenes, steps)


class _Tape(Watcher):
    """Keeps what was decided when."""

    def __init__(self, agent: str) -> None:
        self.decisions: list[tuple[int, Action]] = []
        self._agent = agent

    def decided(self, episode: Episode, decision: Decision) -> None:
        action = decision.robot if self._agent == "receiver" else decision.giver
        self.decisions.append((episode.steps, action.copy()))


class _Supervised:
    """A policy whose observations are looked at before and after."""

    def __init__(self, policy: Policy) -> None:
        self._policy, self.name = policy, policy.name
        self.sight, self.observes = policy.sight, policy.observes

    def prepare(self, object_names: Sequence[str]) -> None:
        self._policy.prepare(object_names)

    def reset(self, seed: int | None = None) -> None:
        self._policy.reset(seed)

    def act(self, observation: Observation) -> npt.NDArray[np.float32]:
        before = {key: value.copy() for key, value in observation.items()}
        action = self._policy.act(observation)
        changed = [key for key, value in before.items() if not np.array_equal(value, observation[key])]
        if changed:
            raise ConformanceError(
                f"{self.name!r} writes into its observation ({', '.join(changed)}); copy what you change"
            )
        return action

    @property
    def hold_time(self) -> float:
        hold_time = self._policy.hold_time
        held_steps(hold_time)
        return hold_time


def _check(agent: str, policy: PolicyLike, dataset: Dataset, scenes: Sequence[int], steps: int) -> None:
    reference = policy_reference(agent, policy).resolved(dataset)
    # Bullet draws more slowly than rays are cast, but needs no extra.
    physics, renderer = ("fast", "bullet") if pybullet_installed() else ("mujoco", "rays")
    episode = Episode(physics, sight=SightConfig(renderer=renderer))
    partner = None if agent == "receiver" else policy_reference("receiver", "yang2021").make(dataset)

    def played(player: Policy, scene: int, seed: int) -> list[tuple[int, Action]]:
        episode.reset(dataset.scene(scene))
        tape, live = _Tape(agent), _Supervised(player)
        if partner is None:
            play(episode, live, seed=seed, until=steps, watchers=[tape])
        else:
            play(episode, partner, live, seed=seed, until=steps, watchers=[tape])
        return tape.decisions

    try:
        used = reference.make(dataset)
        first = [played(used, scene, seed) for seed, scene in enumerate(scenes)]
        # As in another worker: a new one, other scenes before, other draws from global generators.
        np.random.seed(1)  # noqa: NPY002
        random.seed(1)
        new = reference.make(dataset)
        for seed, scene in reversed(list(enumerate(scenes))):
            _compare(reference.label, scene, first[seed], played(new, scene, seed), "played in another order")
        for seed, scene in enumerate(scenes):
            _compare(reference.label, scene, first[seed], played(used, scene, seed), "played once more")
    finally:
        episode.close()


def _compare(
    label: str, scene: int, first: list[tuple[int, Action]], second: list[tuple[int, Action]], how: str
) -> None:
    for (step, action), (other_step, other) in zip(first, second, strict=False):
        if step != other_step or not np.array_equal(action, other):
            raise ConformanceError(
                f"{label!r} acts otherwise in scene {scene} at step {step} when {how}: reset(seed) must forget the "
                "last episode, and all that is drawn must come from a generator seeded there"
            )
    if len(first) != len(second):
        raise ConformanceError(f"{label!r} is asked {len(first)} times in scene {scene} and {len(second)} when {how}")
