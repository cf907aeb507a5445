"""Tests of several cameras, their sizes and their calibration, with every renderer."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from trimesh.triangles import closest_point

import handover_marl
from handover_marl.config import CAMERAS, CameraConfig, make_camera
from handover_marl.envs.constructors import single_agent_env
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.meshes import read_visual_meshes
from handover_marl.geometry.poses import transform_points
from handover_marl.simulation.camera.images import SegmentationLabel
from tests.evaluation.demonstrations.recording import SCENES, record
from tests.helpers.equality import assert_equal

Observation = dict[str, npt.NDArray[Any]]

WIDE = make_camera("wrist", name="wide", width=200, height=96, vertical_fov=60.0)
SKEW = CameraConfig(
    96, 128, 40.0, 0.05, 3.0, (0.02, -0.05, 0.03), (0.0, 0.0, 0.5), (0.0, 1.0, 0.1), "panda_hand", "skew"
)
EVERY = ("wrist", "front", "over_shoulder", WIDE, SKEW)
NAMES = ("wrist", "front", "over_shoulder", "wide", "skew")
SCENE = {"scene_id": 14}
OPTIONS: dict[str, Any] = {"split": "val", "cameras": EVERY, "dataset": "synthetic"}
#: Combinations of physics and renderer.
RENDERERS = (("exact", "bullet"), ("fast", "rays"), ("mujoco", "rays"), ("mujoco", "bullet"))


def make(physics: str = "mujoco", renderer: str = "rays", **options: Any) -> HandoverEnv:
    options = {**OPTIONS, "obs_mode": "rgbd+segmentation", **options}
    return handover_marl.parallel_env(physics=physics, renderer=renderer, **options)


def observe(env: HandoverEnv, steps: int) -> Observation:
    observation = env.reset(seed=0, options=SCENE)[0]["receiver"]
    for _ in range(steps):
        actions = {"giver": np.zeros(8, np.float32), "receiver": observation["robot_joint_position"]}
        observation = env.step(actions)[0]["receiver"]
    return observation


def deproject_to_world(env: Any, observation: Observation, name: str) -> npt.NDArray[np.float64]:
    """Return the world points (h, w, 3) of a depth image by nothing but the observation and `camera_info`."""
    info, depth = env.camera_info()[name], observation[f"{name}_depth"].astype(np.float64)
    rows, columns = np.indices((info.height, info.width))
    own = depth * (np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(info.K).T)
    points = own @ info.extrinsics[:3, :3].T + info.extrinsics[:3, 3]
    return (
        points if info.link == "" else np.asarray(transform_points(observation["gripper_pose"].astype(float), points))
    )


def assert_on_surfaces(env: Any, observation: Observation, name: str) -> None:
    """Assert that the pixels of the table, of the target and of the ground are where these bodies are."""
    points, labels = deproject_to_world(env, observation, name), observation[f"{name}_segmentation"][..., 0]
    table = points[labels == SegmentationLabel.TABLE]
    assert len(table) > 500
    # Most pixels show the top, the others its edges and the legs.
    assert table[:, 2].max() < 0.92 + 1e-3
    assert np.mean(table[:, 2] > 0.92 - 1e-3) > 0.8
    target = points[labels == SegmentationLabel.TARGET]
    assert len(target) > 8
    assert compute_distances_to_target(env, observation, target[:: len(target) // 8]).max() < 5e-4


def compute_distances_to_target(env: Any, observation: Observation, points: npt.NDArray[np.float64]) -> Any:
    """Return the distances (n,) of world points (n, 3) from the triangles of the target object's visual mesh."""
    urdf = env.unwrapped.dataset.load_scene(SCENE["scene_id"]).assets.objects[0]
    (mesh,) = read_visual_meshes(urdf, read_tree(urdf))
    vertices = transform_points(observation["object_poses"][0].astype(float), mesh.vertices.astype(float))
    triangles = np.asarray(vertices)[mesh.faces]
    pairs = np.repeat(points, len(triangles), axis=0)
    nearest = closest_point(np.tile(triangles, (len(points), 1, 1)), pairs)
    return np.linalg.norm(nearest - pairs, axis=1).reshape(len(points), -1).min(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(("physics", "renderer"), RENDERERS)
def test_deprojected_depth_is_on_the_bodies(physics: str, renderer: str) -> None:
    env = make(physics, renderer, obs_mode="state+rgbd+segmentation", control_period=1.4)
    observation = observe(env, 1)
    for name in NAMES:
        assert_on_surfaces(env, observation, name)
    env.close()


@pytest.mark.slow
def test_device_renders_every_camera() -> None:
    pytest.importorskip("torch", reason="needs the extra `warp`")
    pytest.importorskip("warp", reason="needs the extra `warp`")
    options = {**OPTIONS, "obs_mode": "state+rgbd+segmentation+pointcloud"}
    envs, env = handover_marl.vector_env(2, "receiver", backend="warp", **options), make(**options)
    observations, infos = envs.reset(seed=0, options=SCENE)
    expected = env.reset(options=SCENE)[0]["receiver"]
    for name in NAMES:
        own = {key: value.numpy()[1] for key, value in observations.items()}
        assert_on_surfaces(env, own, name)
        assert envs.single_observation_space.contains(own)
        for key in ("depth", "segmentation", "rgb"):
            assert np.mean(np.abs(own[f"{name}_{key}"].astype(float) - expected[f"{name}_{key}"]) > 1.0) < 2e-3
        np.testing.assert_array_equal(own[f"{name}_point_counts"] > 0, expected[f"{name}_point_counts"] > 0)
        np.testing.assert_array_equal(infos[f"{name}_K"][1], env.camera_info()[name].K)
    envs.close()
    env.close()


@pytest.mark.slow
def test_points_of_every_camera_are_in_the_frame_of_its_link() -> None:
    env = make(obs_mode="state+pointcloud", camera_model="pinhole")
    observation = observe(env, 2)
    for name in NAMES:
        count = int(observation[f"{name}_point_counts"][0])
        points = observation[f"{name}_object_points"][: min(count, 1024)].astype(float)
        if env.camera_info()[name].link:
            points = np.asarray(transform_points(observation["gripper_pose"].astype(float), points))
        assert count > 8
        assert compute_distances_to_target(env, observation, points[:: len(points) // 8]).max() < 5e-4
    env.close()


def test_default_calibration_is_that_of_handoversim() -> None:
    env = handover_marl.parallel_env(dataset="synthetic")
    (info,) = env.camera_info().values()
    assert (info.width, info.height, info.link) == (224, 224, "panda_hand")
    np.testing.assert_array_equal(info.K, [[112, 0, 112], [0, 112, 111], [0, 0, 1]])
    pose = [[0, -1, 0, 0.036], [1, 0, 0, 0], [0, 0, 1, 0.036], [0, 0, 0, 1]]
    np.testing.assert_array_equal(info.extrinsics, pose)
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_infos_have_the_calibration(autoreset: str) -> None:
    options = {"dataset": "synthetic", "obs_mode": "depth", "cameras": ("wrist", SKEW), "max_cycles": 2}
    envs = handover_marl.vector_env(3, "receiver", autoreset=autoreset, **options)
    single = single_agent_env("receiver", physics="mujoco", **options)
    expected = {f"{name}_K": info.K for name, info in single.camera_info().items()}
    expected |= {f"{name}_extrinsics": info.extrinsics for name, info in envs.camera_info().items()}
    infos = [single.reset(seed=0)[1], envs.reset(seed=0)[1]]
    action = np.array(envs.single_action_space.sample())
    for _ in range(3):
        infos.append(envs.step(np.tile(action, (3, 1)))[-1])
    for info in infos:
        for key, value in expected.items():
            assert (info[key] == value).all()
    _, info = envs.reset(options={"reset_mask": np.array([False, True, False])})
    assert info["skew_K"][1].any()
    assert not info["skew_K"][[0, 2]].any()
    assert "wrist_K" not in single_agent_env("receiver", dataset="synthetic").reset()[1]
    envs.close()


@pytest.mark.slow
def test_wrist_camera_is_the_same_beside_others() -> None:
    env, alone = make(), make(cameras=("wrist",))
    both, one = observe(env, 2), observe(alone, 2)
    assert_equal({key: both[key] for key in one}, one)
    assert set(both) - set(one) == {f"{name}_{key}" for name in NAMES[1:] for key in ("rgb", "depth", "segmentation")}
    assert both["wide_rgb"].shape == (96, 200, 3)
    assert env.observation_space("receiver").contains(both)
    env.close()
    alone.close()


def test_a_period_repeats_images() -> None:
    slow = make_camera("wrist", name="slow", width=32, height=32, period=0.25)
    fast = dataclasses.replace(slow, name="fast", period=0.0)
    env = make(cameras=(slow, fast), obs_mode="state+depth")
    observation = env.reset(seed=0, options=SCENE)[0]["receiver"]
    seen = [observation]
    for _ in range(5):
        actions = {"giver": np.zeros(8, np.float32), "receiver": observation["robot_joint_position"] + np.float32(0.1)}
        seen.append(env.step(actions)[0]["receiver"])
    # Images of 0, 0, 0, 0.25, 0.25 and 0.5 s are observed every 0.1 s.
    for first, second, are_equal in ((0, 1, True), (1, 2, True), (2, 3, False), (3, 4, True), (4, 5, False)):
        assert np.array_equal(seen[first]["slow_depth"], seen[second]["slow_depth"]) == are_equal
        assert not np.array_equal(seen[first]["fast_depth"], seen[second]["fast_depth"])
    np.testing.assert_array_equal(seen[5]["slow_depth"], seen[5]["fast_depth"])
    env.close()


@pytest.mark.parametrize(
    ("cameras", "error", "message"),
    [
        ("wrist", OptionError, "a tuple of names"),
        (("wrist", "back"), UnknownNameError, "unknown camera 'back'"),
        (("wrist", CAMERAS["wrist"]), OptionError, "different names"),
        ((7,), OptionError, "must be a CameraConfig"),
        ((), OptionError, "cameras must not be empty with obs_mode='depth'"),
    ],
)
def test_wrong_cameras_are_refused(cameras: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        handover_marl.parallel_env(dataset="synthetic", cameras=cameras, obs_mode="depth")
    assert handover_marl.EvaluationConfig(cameras=iter(["wrist"])).cameras == ("wrist",)


def test_partners_do_not_change_cameras() -> None:
    images: list[Any] = []

    def look(transition: Any) -> dict[str, Any]:
        images[:] = [one["receiver"]["front_depth"] for one in (transition.observations, transition.next_observations)]
        return {"receiver": {"none": 0.0}, "giver": {}}

    options: dict[str, Any] = {"obs_mode": "state+depth", "cameras": ("front",), "physics": "mujoco", "rewards": look}
    options["camera_randomization"] = handover_marl.CameraRandomization(position=0.05)
    env = handover_marl.control_agent(handover_marl.parallel_env(dataset="synthetic", **options), "giver", "hold")
    env.reset(seed=0)
    env.step({"giver": np.zeros(8)})
    assert np.mean(images[0] != images[1]) < 0.2


@pytest.mark.slow
def test_demonstrations_describe_their_cameras(tmp_path: Path) -> None:
    found = record(tmp_path, scenes=SCENES[:1], obs_mode="depth", cameras=("wrist", SKEW), physics="mujoco")
    env = make(cameras=("wrist", SKEW))
    assert found.observation_space["skew_depth"].shape == found[0].observations["skew_depth"].shape[1:] == (128, 96, 1)
    for name, info in env.camera_info().items():
        assert_equal(vars(found.camera_info()[name]), vars(info))
    env.close()
