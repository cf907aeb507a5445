"""Tests of fast physics against exact physics on synthetic scenes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl import receivers
from handover_marl.config import CameraConfig, PandaConfig, PhysicsConfig
from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.dataset import Scene
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS
from handover_marl.policies.policy import Action, Policy
from handover_marl.simulation.bullet import world as bullet_world
from handover_marl.simulation.bullet.bodies import HandBody
from handover_marl.simulation.bullet.client import connect, load_urdf
from handover_marl.simulation.bullet.fast_world import FastWorld
from handover_marl.simulation.bullet.sleepable_bodies import KinematicHand
from handover_marl.simulation.reference_tracking import track_references
from tests.playing import play

START = np.array(PandaConfig().start_joints, dtype=np.float32)
DATA = SyntheticDataset()
#: Scenes of s0 val in which Yang's receiver ends the episode early and with different outcomes.
SCENES = (9, 14, 19)


def outcome(episode: Episode) -> tuple[EpisodeStatus, int, int | None]:
    return episode.status, episode.steps, episode.release_step


def world_of(episode: Episode) -> FastWorld:
    assert isinstance(episode.world, FastWorld)
    return episode.world


@pytest.fixture
def fast() -> Episode:
    return Episode("fast")


@pytest.fixture
def both() -> tuple[Episode, Episode]:
    return Episode("exact"), Episode("fast")


def test_states_are_equal_far_from_the_robot(both: tuple[Episode, Episode]) -> None:
    scene = DATA.load_scene(209)
    for episode in both:
        episode.reset(scene)
    tolerances = {"hand_dof_position": 3e-3, "hand_keypoints": 5e-4, "object_poses": 1e-5}
    for steps in (0, 1, 99, 400, 1000, 1500):
        seen = []
        for episode in both:
            episode.advance(START, steps)
            seen.append(episode.observe())
        for key, exact in seen[0].items():
            atol = tolerances.get(key, 1e-6)
            np.testing.assert_allclose(seen[1][key], exact, rtol=0, atol=atol, err_msg=key)
        np.testing.assert_allclose(both[1].world.read_object_joints(), both[0].world.read_object_joints(), atol=1e-5)
    world = world_of(both[1])
    assert world._hand is not None
    assert not world._hand.bodies, "nothing was near"
    assert not any(item.is_awake for item in world._objects)


# Outcomes of the scenes 9, 14 and 19 are compared in `tests/evaluation/test_golden.py`.
@pytest.mark.parametrize("scene_id", [24, 34])
def test_yang_ends_alike(both: tuple[Episode, Episode], scene_id: int) -> None:
    policy = receivers.make("yang2021", DATA)
    for episode in both:
        play(episode, DATA.load_scene(scene_id), policy)
    exact, fast = map(outcome, both)
    assert exact[0] == fast[0]
    assert abs(exact[1] - fast[1]) <= 100


def assert_used_world_equals_new_ones(policy: Policy, scene_ids: tuple[int, ...]) -> None:
    """Play scenes in one world, and check that all but the first are bit-equal to those in a new world."""

    def record(episode: Episode, scene_id: int) -> tuple[Any, ...]:
        actions, _ = play(episode, DATA.load_scene(scene_id), policy)
        return actions, outcome(episode), episode.observe()

    used, in_new_worlds = Episode("fast"), {}
    in_new_worlds[scene_ids[0]] = record(used, scene_ids[0])
    for scene_id in scene_ids[1:]:
        if scene_id not in in_new_worlds:
            new = Episode("fast")
            in_new_worlds[scene_id] = record(new, scene_id)
            new.close()
        actions, end, seen = record(used, scene_id)
        np.testing.assert_array_equal(actions, in_new_worlds[scene_id][0])
        assert end == in_new_worlds[scene_id][1]
        for key, value in seen.items():
            np.testing.assert_array_equal(value, in_new_worlds[scene_id][2][key], err_msg=key)
    used.close()


def test_a_used_world_equals_a_new_one() -> None:
    """An episode in a used world is bit-equal to one in a new world, whichever episodes were simulated before."""
    assert_used_world_equals_new_ones(receivers.make("yang2021", DATA), (*SCENES, *SCENES[1::-1]))


@pytest.mark.slow
def test_fast_motion_leaves_no_trace_in_the_next_episode() -> None:
    """An arm that hits itself and the table leaves nothing in Bullet's cache of pairs that changes a later episode."""
    assert_used_world_equals_new_ones(receivers.make("random", DATA), (209, 214, 209, 219))


def test_the_control_period_does_not_matter(fast: Episode) -> None:
    scene = DATA.load_scene(SCENES[0])
    goal = START + np.array([0.3, 0.2, 0.1, 0.1, 0.0, 0.2, 0.0, 0.0, 0.0], dtype=np.float32)
    ends = []
    for period in (1, 7, 100):
        fast.reset(scene)
        for first in range(0, 700, period):
            fast.advance(goal, min(period, 700 - first))
        ends.append({**fast.observe(), "dof": fast.world.read_object_joints()})
    for end in ends[1:]:
        for key, value in end.items():
            np.testing.assert_allclose(value, ends[0][key], atol=2e-6, err_msg=key)


@pytest.mark.parametrize("physics", ["exact", "fast"])
def test_windows_show_the_state_and_change_nothing(physics: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The window's client shows all bodies; here it has no screen."""
    monkeypatch.setattr(bullet_world, "connect", lambda window=False: connect())
    episodes = [Episode(physics, window=window) for window in (True, False)]
    for episode in episodes:
        for number in (SCENES[0], 209):
            episode.reset(DATA.load_scene(number))
            episode.advance(START, 440)
    shown, alone = (episode.observe() for episode in episodes)
    for key, value in shown.items():
        np.testing.assert_array_equal(value, alone[key], err_msg=key)
    world = episodes[0].world
    assert isinstance(world, bullet_world.BulletWorld)
    assert world._shown is not None
    poses = [body.read_pose() for body in world._shown._objects]
    np.testing.assert_allclose(poses, world.read_state().object_poses, atol=1e-5)
    for episode in episodes:
        episode.close()


def test_rendering_changes_nothing(fast: Episode) -> None:
    scene = DATA.load_scene(SCENES[1])
    actions, _ = play(fast, scene, receivers.make("yang2021", DATA))
    undisturbed = outcome(fast)
    fast.reset(scene)
    camera = CameraConfig(width=32, height=24)
    for step, action in enumerate(actions):
        if step % 500 == 0:
            fast.render(camera)
        fast.advance(action, 1)
    assert outcome(fast) == undisturbed


@pytest.mark.parametrize("frame", [0, 1500])
def test_images_are_alike(both: tuple[Episode, Episode], frame: int) -> None:
    pictures = []
    for episode in both:
        episode.reset(DATA.load_scene(209))
        episode.advance(START, frame)
        pictures.append(episode.render(CameraConfig(width=160, height=120)).astype(int))
    assert (np.abs(pictures[0] - pictures[1]).max(axis=2) > 40).mean() < 0.002


def load_late_scene(scene_id: int, first: int = 2300) -> Scene:
    """Return a scene that begins late in its recording, when the hand holds out the object."""
    scene = DATA.load_scene(scene_id)
    assert scene.hand_last == scene.n_frames - 1, "the hand stays"
    motion = {"object_dof": scene.object_dof[first:], "hand_dof": scene.hand_dof[first:]}
    return replace(scene, **motion, hand_first=0, hand_last=scene.hand_last - first)


def throw(physics: str, scene: Scene, targets: list[Action]) -> tuple[EpisodeStatus, int]:
    """Return status and steps after the arm was driven to two joint targets in turn."""
    episode = Episode(physics)
    episode.reset(scene)
    episode.advance(START, 100)
    for target, steps in zip(targets, (250, 500), strict=True):
        episode.advance(target, steps)
    episode.close()
    return episode.status, episode.steps


@pytest.mark.parametrize(("scene_id", "seed", "touches"), [(8, 4, True), (22, 19, True), (53, 19, True), (5, 4, False)])
def test_no_contact_with_the_hand_is_missed(scene_id: int, seed: int, touches: bool) -> None:
    """An arm that moves to random joint positions touches the hand in both engines, at most 3 steps apart."""
    rng, lower, upper = np.random.default_rng(seed), np.array(LOWER_LIMITS), np.array(UPPER_LIMITS)
    targets = []
    for _ in range(2):
        target = START.copy()
        target[:7] = lower[:7] + rng.uniform(0.2, 0.8, 7) * (upper - lower)[:7]
        targets.append(target)
    exact, fast = (throw(physics, load_late_scene(scene_id), targets) for physics in ("exact", "fast"))
    assert bool(exact[0] & EpisodeStatus.HUMAN_CONTACT) == touches
    assert bool(fast[0] & EpisodeStatus.HUMAN_CONTACT) == touches
    assert abs(exact[1] - fast[1]) <= 3


def test_hands_that_come_and_go(fake_data: Path, both: tuple[Episode, Episode]) -> None:
    scene = OfficialDataset(fake_data).load_scene(14)
    for episode in both:
        episode.reset(scene)
    for _ in range(45):
        seen = []
        for episode in both:
            episode.advance(START, 10)
            seen.append(episode.observe())
        assert seen[0]["hand_present"] == seen[1]["hand_present"]
        np.testing.assert_allclose(seen[1]["hand_keypoints"], seen[0]["hand_keypoints"], atol=1e-3)
        np.testing.assert_allclose(seen[1]["object_poses"], seen[0]["object_poses"], atol=1e-3)


HANDS: list[Callable[[Path], Path]] = [
    lambda fake: DATA.load_scene(209).assets.hand,
    lambda fake: OfficialDataset(fake).load_scene(14).assets.hand,
]


@pytest.mark.parametrize("hand_file", HANDS)
def test_kinematics_equal_bullets(hand_file: Callable[[Path], Path], fake_data: Path) -> None:
    urdf = hand_file(fake_data)
    client = connect()
    body = load_urdf(client, urdf, useFixedBase=True)
    hand = HandBody(client, urdf, [0.0] * 51, PhysicsConfig().hand)
    tree = read_tree(urdf)
    joints = np.random.default_rng(0).uniform(-1.5, 1.5, (3, 51))
    poses = tree.compute_link_poses(joints, range(len(tree.joints)))
    for row, dof in enumerate(joints):
        hand.reset_joints(dof.tolist())
        for link in range(client.getNumJoints(body)):
            state = client.getLinkState(hand.id, link, computeForwardKinematics=1)
            np.testing.assert_allclose(poses[row, link, :3], state[4], atol=1e-5)
            assert abs(np.dot(poses[row, link, 3:], state[5])) == pytest.approx(1.0, abs=1e-6)


def test_kinematic_bodies_match_the_simulated_hand() -> None:
    """Distances from the kinematic hand to a small ball at 40 positions equal those from the exact world's hand."""
    scene = DATA.load_scene(209)
    client = connect()
    frame = np.array([scene.n_frames - 1])
    hand = KinematicHand(client, scene.assets.hand, PhysicsConfig().hand)
    hand.reset(scene.hand_dof[-1])
    track_references([(hand, scene.hand_dof[frame], None)])
    hand.wake(0)
    hand.move_bodies(0)
    whole = HandBody(client, scene.assets.hand, scene.hand_dof[-1].tolist(), PhysicsConfig().hand)
    ball = client.createMultiBody(0.0, client.createCollisionShape(client.GEOM_SPHERE, radius=0.005))
    rng = np.random.default_rng(0)
    for offset in rng.uniform(-0.15, 0.15, (40, 3)):
        position = (scene.hand_dof[-1, :3] + offset).tolist()
        client.resetBasePositionAndOrientation(ball, position, [0.0, 0.0, 0.0, 1.0])
        nearest = [
            min(point[8] for body in bodies for point in client.getClosestPoints(ball, body, 1.0))
            for bodies in ([whole.id], hand.bodies)
        ]
        assert nearest[0] == pytest.approx(nearest[1], abs=1e-4)
