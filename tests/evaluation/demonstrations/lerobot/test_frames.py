"""Tests of frames at a constant rate: their times, observations and actions."""

import json
from pathlib import Path

import numpy as np
import pytest

from handover_marl.episode.observations import receiver_observation_space
from handover_marl.episode.spaces import OBS_MODES
from handover_marl.evaluation.demonstrations.demonstration import Demonstration
from handover_marl.evaluation.demonstrations.lerobot.arrow_files import encode_video
from handover_marl.evaluation.demonstrations.lerobot.features import (
    INDEX_FEATURES,
    format_task,
    list_features,
    make_columns,
)
from handover_marl.evaluation.demonstrations.lerobot.recorder import compute_frame_step, hold_actions
from handover_marl.evaluation.demonstrations.lerobot.statistics import compute_statistics, merge_statistics
from tests.evaluation.demonstrations.lerobot.reading import read_frames, read_info, read_rows
from tests.evaluation.demonstrations.recording import HORIZON, SCENES, record

pytest.importorskip("pyarrow")
pytest.importorskip("imageio_ffmpeg")
FPS = 30  # does not divide 1000, the number of physics steps in a second


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a recording whose frames fall between physics steps; do not write to it."""
    record(None, folder := tmp_path_factory.mktemp("frames") / "out", format="lerobot", fps=FPS, giver="noisy")
    return folder


@pytest.fixture(scope="module")
def decisions(tmp_path_factory: pytest.TempPathFactory) -> list[Demonstration]:
    """Return the same episodes with an observation at each decision."""
    return list(record(None, tmp_path_factory.mktemp("decisions") / "out", giver="noisy"))


@pytest.fixture(scope="module")
def every_step(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """Return the columns of the first episode, recorded with a frame at each physics step."""
    out = tmp_path_factory.mktemp("steps") / "out"
    record(None, out, format="lerobot", fps=1000, giver="noisy", scenes=SCENES[:1])
    return read_frames(out, 0)


def held(actions: np.ndarray, starts: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the actions in effect at `steps`, given the step at which each starts; zeros before the first one."""
    before = np.zeros((1, actions.shape[1]), actions.dtype)
    return np.concatenate([before, actions])[np.searchsorted(starts, steps, side="right")]


def test_actions_are_those_of_the_decisions(out: Path, decisions: list[Demonstration]) -> None:
    steps = np.array([0, 33, 67, 100, 133, 167, 200, 233, 267, 300, 333, 367, 400, 433, 467, 500, 533, 567])
    for number, demonstration in enumerate(decisions):
        frames = read_frames(out, number)
        expected = held(demonstration.actions, demonstration.steps[:-1], steps)
        np.testing.assert_array_equal(frames["action"].astype(np.float32), expected)
        expected = held(demonstration.giver_actions, demonstration.giver_steps, steps)
        np.testing.assert_array_equal(frames["giver.action"].astype(np.float32), expected)
        assert len(np.unique(expected, axis=0)) > 3
        assert frames["frame_index"].tolist() == list(range(len(steps)))
        np.testing.assert_array_equal(frames["timestamp"].astype(np.float32), (np.arange(18) / FPS).astype(np.float32))


def test_observations_are_those_of_the_nearest_step(
    out: Path, decisions: list[Demonstration], every_step: dict[str, np.ndarray]
) -> None:
    frames, demonstration = read_frames(out, 0), decisions[0]
    assert len(every_step["action"]) == HORIZON
    nearest = np.rint(np.arange(18) * 1000.0 / FPS).astype(int)
    for name in ("observation.state", "observation.joint_velocity", "observation.environment_state", "action"):
        np.testing.assert_array_equal(frames[name], every_step[name][nearest], err_msg=name)
    # At the steps of decisions, frames equal the receiver's observations.
    steps, observations = demonstration.steps[:-1], {k: v[:-1] for k, v in demonstration.observations.items()}
    for name, key in (("state", "robot_joint_position"), ("gripper_pose", "gripper_pose")):
        np.testing.assert_array_equal(every_step[f"observation.{name}"][steps].astype(np.float32), observations[key])
    np.testing.assert_array_equal(every_step["action"][steps].astype(np.float32), demonstration.actions)
    features = read_info(out)["features"]["observation.environment_state"]
    first = features["names"].index("object_poses.0")
    poses = every_step["observation.environment_state"][steps, first : first + 35].astype(np.float32)
    np.testing.assert_array_equal(poses.reshape(-1, 5, 7), observations["object_poses"])


def test_files_agree(out: Path) -> None:
    info, rows = read_info(out), read_rows(out)
    assert (info["codebase_version"], info["fps"], info["splits"]) == ("v3.0", FPS, {"train": "0:2"})
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 36, 1)
    assert [row["scene_id"] for row in rows] == list(SCENES)
    assert [(row["dataset_from_index"], row["dataset_to_index"], row["length"]) for row in rows] == [
        (0, 18, 18),
        (18, 36, 18),
    ]
    assert [(row["outcome"], row["success"], row["tasks"]) for row in rows] == [
        ("timeout", False, ["Take the cracker box from the person's hand."])
    ] * 2
    for number in range(2):
        frames = read_frames(out, number)
        assert set(frames) == set(info["features"])
        for name, values in frames.items():
            shape = tuple(info["features"][name]["shape"])
            assert values.shape == (18, *(() if shape == (1,) else shape)), name
        assert frames["index"].tolist() == list(range(18 * number, 18 * number + 18))
        assert set(frames["episode_index"]) == {number}
        assert set(frames["task_index"]) == {0}
        assert frames["next.done"].tolist() == [False] * 17 + [True]
        assert not frames["next.success"].any()
        mean = rows[number]["stats/action/mean"]
        np.testing.assert_allclose(mean, frames["action"].mean(axis=0), rtol=1e-6, atol=1e-9)
    statistics = json.loads((out / "lerobot" / "meta" / "stats.json").read_text())
    both = np.concatenate([read_frames(out, number)["action"] for number in range(2)])
    np.testing.assert_allclose(statistics["action"]["std"], both.std(axis=0), rtol=1e-5, atol=1e-9)
    assert statistics["action"]["count"] == [36]


def test_columns_have_lerobots_types(out: Path) -> None:
    """Vectors are stored as lists of fixed size, and values of one component as numbers."""
    from pyarrow import parquet

    schema = parquet.read_schema(out / "lerobot" / "data" / "chunk-000" / "file-000.parquet")
    assert str(schema.field("action").type).startswith("fixed_size_list<")
    assert str(schema.field("timestamp").type) == "float"
    assert str(schema.field("next.done").type) == "bool"
    assert str(schema.field("index").type) == "int64"


def test_clouds_and_images_have_fixed_shapes(tmp_path: Path) -> None:
    from imageio_ffmpeg import read_frames as read_video
    from pyarrow import parquet

    scenes = {"scenes": SCENES[:1]}
    (points,) = record(None, tmp_path / "points", obs_mode="state+pointcloud", **scenes)
    record(None, tmp_path / "clouds", format="lerobot", fps=5, obs_mode="pointcloud", **scenes)
    frames = read_frames(tmp_path / "clouds", 0)
    for name in ("wrist_object_points", "wrist_hand_points", "wrist_point_counts"):
        np.testing.assert_array_equal(frames[f"observation.{name}"][0], points.observations[name][0])
    assert frames["observation.wrist_object_points"].shape == (3, 1024, 3)
    schema = parquet.read_schema(tmp_path / "clouds" / "lerobot" / "data" / "chunk-000" / "file-000.parquet")
    kind = str(schema.field("observation.wrist_object_points").type)
    assert kind.count("list<") == 2
    assert kind.count("float") == 1
    assert "observation.environment_state" not in frames

    (images,) = record(None, tmp_path / "images", obs_mode="rgbd", **scenes)
    record(None, tmp_path / "video", format="lerobot", fps=5, obs_mode="rgbd", **scenes)
    frames = read_frames(tmp_path / "video", 0)
    for name in ("wrist_depth", "wrist_segmentation"):
        np.testing.assert_array_equal(frames[f"observation.{name}"][0], images.observations[name][0])
    file = tmp_path / "video" / "lerobot" / "videos" / "observation.images.wrist" / "chunk-000" / "file-000.mp4"
    description, *pictures = read_video(file)
    assert (description["size"], description["fps"], len(pictures)) == ((224, 224), 5.0, 3)
    picture = np.frombuffer(pictures[0], np.uint8).reshape(224, 224, 3).astype(float)
    assert np.abs(picture - images.observations["wrist_rgb"][0]).mean() < 4.0
    (row,) = read_rows(tmp_path / "video")
    prefix = "videos/observation.images.wrist"
    assert (row[f"{prefix}/file_index"], row[f"{prefix}/to_timestamp"]) == (0, 3 / 5)
    assert np.array(row["stats/observation.images.wrist/mean"]).shape == (3, 1, 1)


def test_videos_repeat() -> None:
    frames = np.random.default_rng(0).integers(0, 255, (3, 32, 48, 3), np.uint8)
    assert encode_video(frames, 20) == encode_video(frames, 20)


@pytest.mark.parametrize("obs_mode", OBS_MODES)
def test_every_observation_is_a_feature(obs_mode: str) -> None:
    space = receiver_observation_space(obs_mode)
    observations = {key: np.zeros((2, *(part.shape or ())), part.dtype) for key, part in space.items()}
    columns = make_columns(observations, np.zeros((2, 9), np.float32), np.zeros((2, 8), np.float32), success=True)
    features = {feature.name: feature for feature in list_features(obs_mode)}
    assert set(columns) == set(features)
    assert not set(features) & {feature.name for feature in INDEX_FEATURES}
    for name, values in columns.items():
        feature = features[name]
        assert values.shape in ((2, *feature.shape), (2,)), name
        assert feature.dtype in (str(values.dtype), "video"), name
        assert len(feature.names or ()) in (0, feature.shape[0], 3)
    assert columns["next.reward"].tolist() == [0.0, 1.0]
    assert columns["next.success"].tolist() == [False, True]


def test_frame_steps() -> None:
    assert [compute_frame_step(number, 20) for number in range(4)] == [0, 50, 100, 150]
    assert [compute_frame_step(number, 30) for number in range(4)] == [0, 33, 67, 100]
    assert [compute_frame_step(number, 1000) for number in range(3)] == [0, 1, 2]
    # If two steps are equally near, the later one is used.
    assert compute_frame_step(1, 400) == 3


def test_actions_are_held() -> None:
    actions = [(0, np.zeros(1, np.float32)), (50, np.ones(1, np.float32)), (50, np.full(1, 2.0, np.float32))]
    assert hold_actions(actions, np.array([0, 49, 50, 99])).ravel().tolist() == [0.0, 0.0, 2.0, 2.0]


def test_tasks() -> None:
    assert format_task("052_extra_large_clamp") == "Take the extra large clamp from the person's hand."


def test_statistics() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(5, 7, 3)), rng.normal(size=(9, 7, 3))
    merged = merge_statistics([compute_statistics(first), compute_statistics(second)])
    rows = np.concatenate([first, second]).reshape(-1, 3)
    for name, expected in {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}.items():
        np.testing.assert_allclose(merged[name], expected, err_msg=name)
    assert merged["count"] == [14]
    one = compute_statistics(first)
    np.testing.assert_allclose(one["q90"], np.quantile(first.reshape(-1, 3), 0.9, axis=0))
    assert compute_statistics(np.array([True, False]))["mean"] == [0.5]
    image = compute_statistics(np.full((2, 4, 4, 3), 255, np.uint8), is_image=True)
    assert (image["max"], image["count"]) == ([[[1.0]]] * 3, [2])
