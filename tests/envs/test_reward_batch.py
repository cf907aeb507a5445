"""Tests of the rewards of episodes whose arrays are tensors: they equal those of NumPy arrays."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.custom_rewards import combine_rewards
from handover_marl.envs.rewards import SHAPED, TERMS, TermWeights
from handover_marl.envs.transition import Transition
from handover_marl.envs.vector.reward_batch import RewardBatch
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, is_tensor, to_numpy
from handover_marl.simulation.contacts import Contacts
from tests.learning.array_encodings import COUNT, draw_observation
from tests.tensors import make_device_tensors

AGENTS = ("giver", "receiver")
GOAL = np.array(OFFICIAL_CONFIG.protocol.goal_center)


class FakeEpisodes:
    """Episodes whose states are random."""

    def __init__(self, arrays: ArrayFactory) -> None:
        self.arrays = arrays

    def observe(self, seed: int, time: float) -> None:
        """Draw the states of all episodes: near the object and the goal, with and without contacts."""
        rng, make = np.random.default_rng(seed), self.arrays.asarray
        found = draw_observation(seed)
        found["time"][:] = time
        found["hand_keypoints"] = found["gripper_pose"][:, None, :3] + rng.normal(0.0, 0.1, (COUNT, 16, 3))
        self._grasped = rng.random(COUNT) < 0.5
        self._found = found
        self.state = {key: make(values) for key, values in found.items()}
        deviation = rng.normal(0.0, 0.1, (COUNT, 7)) * (rng.random((COUNT, 1)) < 0.8)
        self.motion = SimpleNamespace(deviation=make(deviation), holding=make(rng.random(COUNT) < 0.6))
        self.released = make(rng.random(COUNT) < 0.3)
        status = rng.choice([0, 0, 0, 1, 2, 4, 6, 8, 10], COUNT)
        self.referees = SimpleNamespace(status=make(status))
        self.numbers = make(np.arange(COUNT))

    def are_grasped(self, rows: AnyArray) -> AnyArray:
        return self.arrays.asarray(self._grasped)[rows]

    def read_contacts(self, row: int) -> Contacts:
        assert type(row) is int
        points = np.ones((int(self._grasped[row]), 3), dtype=np.float32)
        return Contacts(finger_points=(points, points), robot_object_force=0.1 * row, robot_hand_force=0.01 * row)

    def select_state(self, rows: AnyArray) -> Observation:
        return {key: values[rows] for key, values in self.state.items()}

    select_giver_observation = select_state

    def make_infos(self, rows: AnyArray) -> dict[str, AnyArray]:
        return {"scene_id": self.numbers[rows], "status": self.referees.status[rows]}


def compare(rewards: Any, seed: int, steps: int = 4) -> dict[str, dict[str, np.ndarray]]:
    """Compare the sums and infos of both namespaces after each call; return the last infos by agent."""
    config = replace(EnvConfig(), rewards=rewards)
    with make_device_tensors() as tensors:
        makers = (NUMPY_ARRAYS, tensors)
        episodes: list[Any] = [FakeEpisodes(arrays) for arrays in makers]
        batches = [RewardBatch(config, own, COUNT) for own in episodes]
        rng = np.random.default_rng(seed)
        for step in range(steps):
            for own in episodes:
                own.observe(seed + step, 0.1 * (step + 1))
            # All episodes start, and later single ones.
            started = range(COUNT) if step == 0 else rng.permutation(COUNT)[: step % 3].tolist()
            rows = np.setdiff1d(rng.permutation(COUNT)[: 4 * step], started)
            actions = {"giver": rng.normal(size=(len(rows), 8)), "receiver": rng.normal(size=(len(rows), 9))}
            ends = rng.random((2, len(rows))) < 0.3
            cleared = rng.permutation(COUNT)[: 5 * (step % 2)]
            for arrays, batch in zip(makers, batches, strict=True):
                for row in started:
                    batch.start(row)
                own_actions = {agent: arrays.asarray(values, "float32") for agent, values in actions.items()}
                batch.clear(arrays.asarray(cleared))
                batch.add(arrays.asarray(rows), own_actions, *map(arrays.asarray, ends))
            for agent in AGENTS:
                some = rng.permutation(COUNT)[:9]
                infos = [
                    batch.make_infos(agent, arrays.asarray(some), True)
                    for arrays, batch in zip(makers, batches, strict=True)
                ]
                assert list(infos[0]) == list(infos[1])
                for key, values in infos[0].items():
                    assert is_tensor(infos[1][key])
                    np.testing.assert_allclose(to_numpy(infos[1][key]), values, rtol=0, atol=1e-6)
                totals = [to_numpy(batch.totals[agent]) for batch in batches]
                np.testing.assert_allclose(totals[1], totals[0], rtol=0, atol=1e-6)
        everywhere = np.arange(COUNT)
        return {agent: batches[0].make_infos(agent, everywhere, True) for agent in AGENTS}


def test_every_term_is_compared() -> None:
    found = compare(TermWeights(dict.fromkeys(TERMS, 1.0), dict.fromkeys(TERMS, -1.0)), 7, 12)
    for agent, infos in found.items():
        for key, values in infos.items():
            assert np.ptp(values) > 0.0, f"{key} of the {agent}"


def reward_motion(transition: Transition) -> dict[str, dict[str, float]]:
    """Return terms that depend on all parts of a transition."""
    for arrays in (*transition.observations.values(), *transition.next_observations.values(), transition.actions):
        assert all(type(values) is np.ndarray for values in arrays.values())
    assert type(transition.infos["giver"]["status"]) is int
    change = transition.next_state["gripper_pose"] - transition.state["gripper_pose"]
    return {
        "giver": {"scene": 0.1 * transition.infos["giver"]["scene_id"], "end": float(transition.terminated)},
        "receiver": {
            "change": float(np.abs(change).sum()),
            "effort": float((transition.actions["receiver"] ** 2).sum()),
            "force": transition.contacts.robot_object_force,
            "status": float(int(transition.status) + 10 * transition.truncated),
        },
    }


def test_functions_get_numpy_arrays() -> None:
    for infos in compare(combine_rewards((0.5, SHAPED), reward_motion), 3, 12).values():
        assert all(np.isfinite(values).all() for values in infos.values())
        assert np.ptp(infos["return"]) > 0.0
