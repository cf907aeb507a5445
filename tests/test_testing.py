"""Tests of the conformance checks for users' policies, on policies that conform and on some that do not."""

import numpy as np
import pytest

from handover_marl import givers
from handover_marl.episode.observations import Observation
from handover_marl.errors import ActionError, ConformanceError
from handover_marl.policies.policy import Action
from handover_marl.receivers import Receiver
from handover_marl.testing import check_giver, check_receiver

ONE = (9,)


class Obedient(Receiver):
    name = "obedient"

    def reset(self, seed: int | None = None) -> None:
        self.rng = np.random.default_rng(seed)

    def act(self, observation: Observation) -> Action:
        return (observation["robot_joint_position"] + 0.001 * self.rng.normal(size=9)).astype(np.float32)


class Scribbling(Obedient):
    def act(self, observation: Observation) -> Action:
        observation["object_poses"] -= 1.0
        return super().act(observation)


class Unseeded(Obedient):
    def reset(self, seed: int | None = None) -> None:
        self.rng = np.random.default_rng()


class Global(Obedient):
    def act(self, observation: Observation) -> Action:
        return observation["robot_joint_position"] + np.float32(0.001 * np.random.random())  # noqa: NPY002


class Remembering(Obedient):
    episodes = 0

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self.episodes += 1

    def act(self, observation: Observation) -> Action:
        return observation["robot_joint_position"] + np.float32(0.001 * self.episodes)


class Short(Obedient):
    def act(self, observation: Observation) -> Action:
        return super().act(observation)[:8]


@pytest.mark.slow
@pytest.mark.parametrize("receiver", [Obedient, "random", "yang2021:wait=0"])
def test_conforming_receivers(receiver: str | type[Receiver]) -> None:
    check_receiver(receiver, scenes=ONE, steps=300)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in givers.list_available() if name not in ("learned", "population")])
def test_our_givers_conform(name: str) -> None:
    check_giver(name, scenes=ONE, steps=400)


@pytest.mark.parametrize(
    ("kind", "error", "message"),
    [
        (Scribbling, ConformanceError, "writes into its observation .object_poses"),
        (Unseeded, ConformanceError, "seeded there"),
        (Global, ConformanceError, "seeded there"),
        (Remembering, ConformanceError, "in another order of scenes"),
        (Short, ActionError, r"shape \(8,\)"),
    ],
)
def test_what_does_not_conform(kind: type[Receiver], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        check_receiver(kind, scenes=(9, 14), steps=200)
