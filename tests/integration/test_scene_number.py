"""Tests that receivers cannot learn number, name and subject of a scene from observations and seeds."""

from dataclasses import replace

import pytest

from handover_marl.config import WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode import camera_observations
from handover_marl.episode.camera_observations import SensorConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import derive_robot_seed, run_episode
from handover_marl.episode.spaces import OBS_PARTS
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.policies.policy import Policy
from tests.episode.test_camera_observations import GOAL, STEPS
from tests.helpers.equality import assert_equal
from tests.integration.test_causality import RECEIVERS, Recorder, assert_same_until, make_receiver

pytestmark = pytest.mark.slow

DATA = open_dataset("synthetic", robot=PANDA_CAMERA)
NOISY_START = WorldConfig(initial_joint_noise=0.02)
#: More than 1,024 pixels show the object after `STEPS` steps towards `GOAL`.
SCENE = DATA.load_scene(9)
RENDERERS = ("bullet", "rays")
#: Receivers that use random numbers or images.
CASES = [reference for reference in RECEIVERS if reference.startswith(("random", "population", "gaddpg", "vision"))]


def rename(scene: Scene, scene_id: int) -> Scene:
    """Return a copy of the scene with another number, name and subject."""
    return replace(scene, info=replace(scene.info, scene_id=scene_id, name=f"x/{scene_id}"))


def start(episode: Episode, scene: Scene, receiver: Policy, end: int) -> None:
    """Let a receiver act in a scene after the robot has moved towards the object."""
    episode.reset(scene, derive_robot_seed(3, scene))
    episode.advance(GOAL, STEPS)
    run_episode(episode, receiver, seed=3, until=STEPS + end)


@pytest.mark.parametrize("reference", CASES, ids=lambda value: value.partition(":")[0])
def test_receivers_do_not_depend_on_the_scene_number(monkeypatch: pytest.MonkeyPatch, reference: str) -> None:
    # Few points, so that all clouds are subsampled.
    monkeypatch.setattr(camera_observations, "N_POINTS", 512)
    receiver = Recorder(make_receiver(reference, DATA))
    episode = Episode("fast", NOISY_START, sensors=SensorConfig("rays"))
    start(episode, SCENE, receiver, 300)
    events = receiver.events
    start(episode, rename(SCENE, 777), receiver, 300)
    assert events
    assert_same_until(STEPS + 300, receiver, events)
    episode.close()


@pytest.mark.parametrize("noise", [None, "realsense"])
@pytest.mark.parametrize("renderer", RENDERERS)
def test_observations_do_not_depend_on_the_scene_number(renderer: str, noise: str | None) -> None:
    config = WorldConfig() if noise is None else NOISY_START
    episode, seen = Episode("fast", config, sensors=SensorConfig(renderer, camera_noise=noise)), []
    for scene in (SCENE, rename(SCENE, 777)):
        start(episode, scene, make_receiver("hold", DATA), 1)
        seen.append([{**episode.observe(), **episode.observe_camera(obs_mode)} for obs_mode in OBS_PARTS])
    assert_equal(*seen)
    episode.close()
