"""Tests of `Episode`: rollouts against single steps, releases by the giver, observations and camera images."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from handover_marl import receivers
from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.episode_batch import EpisodeBatch
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.observations import PROPRIOCEPTION
from handover_marl.episode.referee import EpisodeStatus, ReleaseReason
from handover_marl.simulation.engines import BatchBackend
from handover_marl.simulation.world import NO_POINTS, World

DATASET = SyntheticDataset()
SCENE = DATASET.load_scene(209)
START = np.array(OFFICIAL_CONFIG.physics.panda.start_joints, dtype=np.float32)
#: Step at which the person holds the object of this scene.
HELD = 2800
RELEASE = NO_DEVIATION.copy()
RELEASE[-1] = 1.0
FASTER = NO_DEVIATION.copy()
FASTER[0] = 1.0


@pytest.fixture
def episode(request: pytest.FixtureRequest) -> Iterator[Episode]:
    episode = Episode(getattr(request, "param", "fast"))
    episode.reset(SCENE)
    yield episode
    episode.close()


@pytest.mark.slow
@pytest.mark.parametrize("episode", ["mujoco"], indirect=True)
def test_steps_with_callbacks_equal_rollouts(episode: Episode, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps with callbacks have the outcome of rollouts; the object is released once, after the robot grasped it."""
    releases: list[int] = []
    release_target = type(episode.world).release_target

    def record_release(world: World) -> None:
        releases.append(len(outcomes))
        release_target(world)

    outcomes: list[tuple[object, ...]] = []
    steps: list[int] = []
    monkeypatch.setattr(type(episode.world), "release_target", record_release)
    scene = DATASET.load_scene(9)
    for hooks in ((), (lambda _: steps.append(episode.steps),)):
        episode.reset(scene)
        receiver = receivers.make("yang2021:wait=0", DATASET)
        receiver.prepare(scene.info.object_names)
        receiver.reset(0)
        while not episode.status:
            action = receiver.act(episode.observe())
            episode.advance(action, round(1000 * min(receiver.hold_time, 20.0)), on_step=hooks)
        contacts = episode.contacts._replace(finger_points=(NO_POINTS, NO_POINTS))
        outcomes.append((episode.status, episode.steps, episode.release_reason, episode.release_step, contacts))
        outcomes[-1] += (episode.world.read_joint_snapshot().objects.tolist(),)
    first, second = outcomes
    assert first == second
    assert first[0] is EpisodeStatus.SUCCESS
    assert first[2] is ReleaseReason.ACTIVE
    assert releases == [0, 1]
    assert steps == list(range(1, episode.steps + 1))


@pytest.mark.slow
def test_voluntary_release(episode: Episode) -> None:
    assert not episode.object_offered
    episode.advance(START, 100, RELEASE)
    assert (episode.release_reason, episode.release_step) == (None, None), "the object is not held yet"
    episode.advance(START, HELD - 100)
    assert episode.object_offered is True
    assert episode.contacts.both_fingers_touch is False
    before, moved = episode.observe(), NO_DEVIATION.copy()
    shift = moved[1:4] = np.float32([0.1, -0.15, 0.05])
    episode.advance(START, 1200, moved)
    after = episode.observe()
    np.testing.assert_allclose(after["hand_keypoints"] - before["hand_keypoints"], np.tile(shift, (16, 1)), atol=5e-3)
    np.testing.assert_allclose(after["object_poses"][0, :3] - before["object_poses"][0, :3], shift, atol=5e-3)
    np.testing.assert_allclose(after["object_poses"][1:], before["object_poses"][1:], atol=1e-4)
    episode.advance(START, 1200)
    height = episode.world.read_joint_snapshot().objects[0, 2]
    episode.advance(START, 1, RELEASE)
    assert (episode.release_reason, episode.release_step) == (ReleaseReason.VOLUNTARY, HELD + 2400)
    assert episode.object_offered is False
    episode.advance(START, 100, RELEASE)
    assert episode.release_step == HELD + 2400
    assert episode.world.read_joint_snapshot().objects[0, 2] < height - 0.02, "the object falls"
    assert not episode.observe_giver(episode.observe())["deviation"].any()
    episode.advance(START, 2000)
    assert episode.status == EpisodeStatus.OBJECT_DROP


@pytest.mark.slow
def test_a_requested_release_is_at_the_pick_up_however_steps_are_divided() -> None:
    batch, rows = EpisodeBatch(OFFICIAL_CONFIG, 1, BatchBackend()), np.array([0])
    found = []
    for period in (70, 500):
        for single in (Episode("mujoco"), None):
            (batch if single is None else single).reset(*((SCENE,) if single else (0, SCENE)))
            for _ in range(1500 // period):
                if single is None:
                    batch.advance(rows, START[None], period, (RELEASE + FASTER)[None])
                else:
                    single.advance(START, period, RELEASE + FASTER)
            found.append(int(batch.referees.release_step[0]) if single is None else single.release_step)
    assert len(set(found)) == 1, found


def test_quaternions_have_the_signs_of_exact_physics() -> None:
    poses = []
    for physics in ("exact", "fast", "mujoco"):
        episode = Episode(physics)
        episode.reset(DATASET.load_scene(835))
        poses.append(episode.observe()["object_poses"])
    np.testing.assert_allclose(poses[1:], [poses[0]] * 2, atol=1e-5)


def test_observation_of_a_policy_has_its_mode(episode: Episode) -> None:
    class Policy:
        obs_mode = "pointcloud"

    state = episode.observe()
    assert episode.observe_for_policy(object(), state) is state
    policy = Policy()
    policy.obs_mode = "".join(["sta", "te"])
    assert episode.observe_for_policy(policy, state) is state
    clouds = {"wrist_object_points", "wrist_hand_points"}
    for mode, keys in {
        "pointcloud": {*PROPRIOCEPTION, *clouds, "wrist_point_counts"},
        "state+pointcloud": {*state, *clouds, "wrist_point_counts"},
    }.items():
        policy.obs_mode = mode
        assert episode.observe_for_policy(policy, state).keys() == keys
    assert episode.observe_camera("state") == {}


@pytest.mark.parametrize("physics", ["exact", "fast", "mujoco"])
def test_the_robot_starts_at_drawn_joint_positions(physics: str) -> None:
    config = replace(OFFICIAL_CONFIG, initial_joint_noise=0.1)
    episode = Episode(physics, config)
    for seed in (1, 2, 1):
        episode.reset(SCENE, seed)
        state = episode.observe()
        np.testing.assert_array_equal(state["robot_joint_position"], np.float32(config.draw_initial_joints(seed)))
        assert not state["robot_joint_velocity"].any()
        target = state["robot_joint_position"]
        episode.advance(target, 5)
        np.testing.assert_allclose(episode.observe()["robot_joint_position"], target, atol=1e-4)
    episode.close()
