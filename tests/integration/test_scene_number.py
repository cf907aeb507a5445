"""Tests that receivers cannot learn number, name and subject of a scene from observations and seeds."""

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl.config import WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode import camera_observations
from handover_marl.episode.camera_observations import N_POINTS, WristCameraConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import derive_robot_seed, run_episode
from handover_marl.episode.spaces import OBS_MODES, STATE
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.policies.policy import Policy
from handover_marl.simulation.camera.optics import CAMERA_POSITION_IN_HAND, HALF_SIZE_PX, IMAGE_SIZE
from tests.episode.test_camera_observations import GOAL, STEPS, Looker
from tests.integration.test_causality import RECEIVERS, Recorder, assert_same_until, make_receiver

DATA = open_dataset("synthetic", robot=PANDA_CAMERA)
NOISY_START = WorldConfig(initial_joint_noise=0.02)
#: More than 1,024 pixels show the object after `STEPS` steps towards `GOAL`.
SCENE = DATA.load_scene(9)
RENDERERS = ("bullet", "rays")
CASES = [
    pytest.param(reference, renderer, marks=() if (reference, renderer) == ("vision", "rays") else pytest.mark.slow)
    for reference in RECEIVERS
    for renderer in (RENDERERS if reference.startswith(("gaddpg", "vision")) else RENDERERS[1:])
]


def rename(scene: Scene, scene_id: int) -> Scene:
    """Return a copy of the scene with another number, name and subject."""
    return replace(scene, info=replace(scene.info, scene_id=scene_id, name=f"x/{scene_id}"))


def start(episode: Episode, scene: Scene, receiver: Policy, end: int) -> None:
    """Let a receiver act in a scene after the robot has moved towards the object."""
    episode.reset(scene, derive_robot_seed(3, scene))
    episode.advance(GOAL, STEPS)
    run_episode(episode, receiver, seed=3, until=STEPS + end)


@pytest.mark.parametrize(("reference", "renderer"), CASES, ids=lambda value: value.partition(":")[0])
def test_receivers_do_not_depend_on_the_scene_number(
    monkeypatch: pytest.MonkeyPatch, reference: str, renderer: str
) -> None:
    # Few points, so that all clouds are subsampled.
    monkeypatch.setattr(camera_observations, "N_POINTS", 512)
    receiver = Recorder(make_receiver(reference, DATA))
    episode = Episode("fast", NOISY_START, wrist_camera=WristCameraConfig(renderer))
    start(episode, SCENE, receiver, 500)
    events = receiver.events
    start(episode, rename(SCENE, 777), receiver, 500)
    assert events
    assert_same_until(STEPS + 500, receiver, events)
    episode.close()


@pytest.mark.parametrize("noise", [None, "realsense"])
@pytest.mark.parametrize("renderer", RENDERERS)
def test_observations_do_not_depend_on_the_scene_number(renderer: str, noise: str | None) -> None:
    config = WorldConfig() if noise is None else NOISY_START
    episode, seen = Episode("fast", config, wrist_camera=WristCameraConfig(renderer, camera_noise=noise)), []
    for scene in (SCENE, rename(SCENE, 777)):
        start(episode, scene, Looker(obs_mode=STATE), 1)
        seen.append([{**episode.observe(), **episode.observe_camera(obs_mode)} for obs_mode in OBS_MODES])
    for first, second in zip(*seen, strict=True):
        assert first.keys() == second.keys()
        for key, value in first.items():
            np.testing.assert_array_equal(value, second[key], err_msg=key)
    episode.close()


def guess_scene(
    points: npt.NDArray[np.float32], count: int, seed_of_scene: Callable[[int], tuple[int, ...]]
) -> tuple[int, float]:
    """Return the scene number whose random numbers choose the points best, and the share of points that it explains.

    Between two points of an image row that are on the object there are as many pixels as points were left out.

    Args:
        points: (1024, 3) observed points of the object.
        count: Number of pixels on the object.
        seed_of_scene: Returns the seed of the generator that would choose points in the scene of a number.
    """
    depth = points[:, 2] - CAMERA_POSITION_IN_HAND[2]
    row = np.rint((CAMERA_POSITION_IN_HAND[0] - points[:, 0]) / depth * HALF_SIZE_PX + HALF_SIZE_PX)
    column = np.rint(points[:, 1] / depth * HALF_SIZE_PX + HALF_SIZE_PX)
    gaps = np.diff(row * IMAGE_SIZE + column)
    shares = []
    for scene in range(1000):
        chosen = np.random.default_rng(seed_of_scene(scene)).choice(count, N_POINTS, replace=False)
        shares.append(float((np.diff(np.sort(chosen)) == gaps).mean()))
    return int(np.argmax(shares)), max(shares)


def test_scene_number_cannot_be_decoded_from_points() -> None:
    """Seeds that are hashes of the scene number, as in version 0.8.0, do not explain which points are observed."""

    def hash_seed(scene: int, user: str) -> int:
        return int.from_bytes(hashlib.sha256(f"handover_marl 0 {scene} {user}".encode()).digest()[:4], "big")

    episode, looker = Episode("fast", wrist_camera=WristCameraConfig("rays")), Recorder(Looker(obs_mode="pointcloud"))
    episode.reset(SCENE)
    episode.advance(GOAL, STEPS)
    run_episode(episode, looker, seed=0, until=STEPS + 1)
    cloud = episode.capture_wrist_camera().object_points
    (steps, seen, _), *_ = looker.events
    count = int(seen["wrist_point_counts"][0])
    assert count > 1.2 * N_POINTS
    for user in ("camera", "giver", "robot", "receiver"):
        _, share = guess_scene(seen["wrist_object_points"], count, lambda scene: (hash_seed(scene, user), steps, 0))  # noqa: B023
        assert share < 0.8
    # The attack would work: it finds the number if these seeds do choose the points.
    seed = (hash_seed(SCENE.info.scene_id, "camera"), steps, 0)
    chosen = np.sort(np.random.default_rng(seed).choice(len(cloud), N_POINTS, replace=False))
    guess, share = guess_scene(cloud[chosen], len(cloud), lambda scene: (hash_seed(scene, "camera"), steps, 0))
    assert guess == SCENE.info.scene_id
    assert share > 0.9
    episode.close()
