"""Tests of the fingers' contact points, which equal PyBullet's in the frames of the fingers."""

import numpy as np
from scipy.spatial.transform import Rotation

from handover_marl import receivers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import EpisodeCallback, run_episode


class ContactComparison(EpisodeCallback):
    """Callback that compares the contacts of every step with PyBullet's contact points."""

    def __init__(self) -> None:
        self.counts: set[tuple[bool, bool]] = set()

    def on_step(self, episode: Episode) -> None:
        found, world = episode.contacts.finger_points, episode.world
        client, panda = world._client, world._loaded_workcell.panda  # type: ignore[attr-defined]
        self.counts.add((len(found[0]) > 0, len(found[1]) > 0))
        if not episode.contacts.robot_touches_object or episode.steps % 10:
            return
        touching = [point for point in client.getContactPoints(panda.id) if point[9] > 0.0]
        for points, link in zip(found, panda.finger_links, strict=True):
            expected = [point[5] for point in touching if point[3] == link]
            assert points.dtype == np.float32
            assert points.shape == (len(expected), 3)
            if expected:
                pose = panda.read_link_poses([link])[0].astype(np.float64)
                local = Rotation.from_quat(pose[3:]).inv().apply(np.array(expected) - pose[:3])
                np.testing.assert_allclose(points, local, atol=1e-6)


def test_contact_points_are_in_the_frames_of_the_fingers() -> None:
    dataset, comparison, episode = SyntheticDataset(), ContactComparison(), Episode("fast")
    episode.reset(dataset.load_scene(209))
    run_episode(episode, receivers.make("yang2021", dataset), callbacks=[comparison])
    episode.close()
    assert {(False, False), (True, True)} < comparison.counts, "one finger touches first"
