"""Receiver with offsets on the joint targets of another one."""

import numpy as np

from handover_marl import receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.policies.perturbed import PerturbedReceiver

DATA = SyntheticDataset()


def test_offsets_of_the_arm() -> None:
    receiver = receivers.make("yang2021", DATA)
    episode = Episode("fast")
    episode.reset(DATA.load_scene(9))
    observation = episode.observe()
    episode.close()
    actions = []
    for offset, seed in ((0.0, 0), (0.001, 0), (0.001, (3, 4)), (0.001, (3, 4))):
        perturbed = PerturbedReceiver(receiver, offset, seed)
        perturbed.reset(0)
        actions.append(perturbed.act(observation))
        assert perturbed.hold_time == receiver.hold_time == 3.0
    receiver.reset(0)
    np.testing.assert_array_equal(actions[0], receiver.act(observation))
    np.testing.assert_array_equal(actions[2], actions[3])
    offsets = [action - actions[0] for action in actions[1:3]]
    np.testing.assert_allclose(np.abs(offsets)[:, :7], 0.001, atol=1e-6)
    np.testing.assert_array_equal(np.array(offsets)[:, 7:], 0.0)
    assert not np.array_equal(offsets[0], offsets[1])
