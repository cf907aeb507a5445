"""Conformance tests for givers and receivers of other packages, to be called from their tests.

from handover_marl.testing import check_receiver


def test_my_receiver():
    check_receiver(MyReceiver)
"""

import random
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.datasets import Dataset, open_dataset
from handover_marl.episode.camera_observations import SensorConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.episode.observations import Observation
from handover_marl.errors import ConformanceError
from handover_marl.execution.options import is_pybullet_installed
from handover_marl.policies.policy import Action, Policy
from handover_marl.policies.reference import PolicyLike, parse_policy

__all__ = ["check_giver", "check_receiver"]

_SCENES = (9, 14)
_STEPS = 4000


def check_receiver(
    receiver: PolicyLike, dataset: Dataset | None = None, scenes: Sequence[int] = _SCENES, steps: int = _STEPS
) -> None:
    """Check that a receiver meets the requirements of evaluations, by running it in a few scenes.

    Requirements: the receiver can be constructed and pickled for worker processes. It does not modify its observations.
    Its actions are valid and depend on seed and scene only, not on earlier episodes, the process or global random
    generators.

    Args:
        receiver: Receiver: a name, a class, an instance or another value that `handover_marl.benchmark` accepts.
        dataset: Dataset of the scenes; default: the synthetic dataset.
        scenes: Numbers of the scenes to simulate.
        steps: Largest number of physics steps per scene.

    Raises:
        ConformanceError: The receiver fails a requirement; the message says which and what to do.
        HandoverError: The receiver cannot be made, fails, or returns a malformed action.
    """
    _check("receiver", receiver, dataset or open_dataset("synthetic"), scenes, steps)


def check_giver(
    giver: PolicyLike, dataset: Dataset | None = None, scenes: Sequence[int] = _SCENES, steps: int = _STEPS
) -> None:
    """Check that a giver meets the requirements of evaluations, by running it with the receiver `yang2021`.

    `giver` is a name, a class or an instance. Requirements, other arguments and errors are those of `check_receiver`.
    """
    _check("giver", giver, dataset or open_dataset("synthetic"), scenes, steps)


class _CheckedPolicy:
    """Policy wrapper that records decisions (time in s, action), and checks that observations are not modified."""

    def __init__(self, policy: Policy) -> None:
        self._policy, self.name = policy, policy.name
        self.obs_mode = policy.obs_mode
        self.decisions: list[tuple[float, Action]] = []

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
                f"{self.name!r} writes into its observation ({', '.join(changed)}); copy arrays before changing them"
            )
        self.decisions.append((float(observation["time"][0]), np.array(action)))
        return action

    @property
    def hold_time(self) -> float:
        return self._policy.hold_time


def _check(agent: str, policy: PolicyLike, dataset: Dataset, scenes: Sequence[int], steps: int) -> None:
    reference = parse_policy(agent, policy).resolve(dataset)
    # Slower than rays, but without an optional dependency.
    physics, renderer = ("fast", "bullet") if is_pybullet_installed() else ("mujoco", "rays")
    episode = Episode(physics, sensors=SensorConfig(renderer=renderer))
    partner = None if agent == "receiver" else parse_policy("receiver", "yang2021").make(dataset)

    def record(live: Policy, scene: int, seed: int) -> list[tuple[float, Action]]:
        episode.reset(dataset.load_scene(scene))
        checked = _CheckedPolicy(live)
        pair = (checked,) if partner is None else (partner, checked)
        run_episode(episode, *pair, seed=seed, until=steps)
        return checked.decisions

    try:
        used = reference.make(dataset)
        first = [record(used, scene, seed) for seed, scene in enumerate(scenes)]
        # As in another worker: new policy, other order of scenes, other global random generators.
        np.random.seed(1)  # noqa: NPY002
        random.seed(1)
        new = reference.make(dataset)
        for seed, scene in reversed(list(enumerate(scenes))):
            _compare(reference.label, scene, first[seed], record(new, scene, seed), "in another order of scenes")
        for seed, scene in enumerate(scenes):
            _compare(reference.label, scene, first[seed], record(used, scene, seed), "in a second run")
    finally:
        episode.close()


def _compare(
    label: str, scene: int, first: list[tuple[float, Action]], second: list[tuple[float, Action]], when: str
) -> None:
    for (time, action), (other_time, other) in zip(first, second, strict=False):
        if time != other_time or not np.array_equal(action, other):
            raise ConformanceError(
                f"{label!r} returns another action in scene {scene} after {time:.3f} s {when}; clear all state in "
                "reset(seed), and draw random numbers from a generator that is seeded there"
            )
    if len(first) != len(second):
        raise ConformanceError(
            f"{label!r} must act equally often in each run, got {len(first)} actions in scene {scene} and "
            f"{len(second)} {when}"
        )
