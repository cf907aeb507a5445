"""Tests of the masks that `vision` predicts: clouds, heights, weights, and the metrics of the network."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from handover_marl import receivers
from handover_marl.assets.shipped import find_vision_weights
from handover_marl.config import OFFICIAL_CONFIG, PandaConfig
from handover_marl.datasets import open_dataset
from handover_marl.episode.camera_observations import CameraSensor, SensorConfig
from handover_marl.episode.episode import Episode
from handover_marl.errors import OptionError
from handover_marl.learning.imitation.vision.segmentation import (
    SegmentationBatches,
    SegmentationLearner,
    SegmentationViews,
)
from handover_marl.learning.networks.segmentation_network import SegmentationNetwork
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.vision.mask_predictor import UNSEGMENTED, load_mask_predictor, segment_clouds
from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.simulation.camera.noise import CameraNoise

pytest.importorskip("embreex")
DATA = open_dataset("synthetic", robot="panda_camera")
SCENE, STEPS = DATA.load_scene(9), 2000
NAMES = ("object", "hand", "other")


@pytest.mark.slow
def test_true_labels_give_the_true_clouds() -> None:
    """Late images with depth noise; in addition, far points of the object and pixels without a depth are left out."""
    noise = CameraNoise(depth_noise_std=0.001, edge_dropout=0.2, latency=0.05)
    episode = Episode("fast", sensors=SensorConfig("rays", camera_noise=noise))
    episode.reset(SCENE)
    camera = CameraSensor(SensorConfig("rays", camera_noise=noise), "fast", OFFICIAL_CONFIG.physics)
    camera.reset(SCENE, episode.world)
    goal = np.array(PandaConfig().start_joints, dtype=np.float32)
    goal[:7] += [0.1, 0.3, 0.05, 0.2, 0.1, 0.3, 0.2]
    for step in range(1, STEPS // 10 + 1):
        episode.advance(goal, 10)
        camera.record_snapshot(episode.world, 10 * step)
    seen = camera.observe(f"full_pointcloud+scene_pointcloud+segmentation+{UNSEGMENTED}", episode.world, STEPS)
    labels, points = seen["wrist_segmentation"][..., 0], seen["wrist_point_map"]
    found: list[tuple[npt.NDArray[Any], ...]] = []

    def predict(*image: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        found.append(image)
        predicted: npt.NDArray[np.uint8] = labels.copy()
        predicted[image[1] > 1.99] = SegmentationLabel.TARGET
        away = np.linalg.norm(points - np.median(points[labels == SegmentationLabel.TARGET], axis=0), axis=-1)
        predicted.flat[np.flatnonzero((away > 0.3) & (labels == SegmentationLabel.TABLE))[:200]] = 3
        return predicted

    context = make_policy_context(DATA)
    arm = ArmInWorld.for_panda(context.panda_urdf, context.panda)
    pose = arm.compute_hand_pose(episode.world.read_joints_float64()[:7])
    clouds = segment_clouds(seen, pose, predict)
    counts = seen["wrist_point_counts"].astype(int)
    assert counts[0] > 1024
    for name, count in zip(NAMES, counts, strict=True):
        cloud = clouds[f"wrist_{name}_points"]
        assert len(cloud) == -(-count // -(-count // 1024)) if count else not len(cloud)
        if f"wrist_{name}_cloud" in seen:
            np.testing.assert_array_equal(cloud, seen[f"wrist_{name}_cloud"][:count][:: -(-count // 1024)])
    np.testing.assert_array_equal(clouds["wrist_point_counts"], [len(clouds[f"wrist_{name}_points"]) for name in NAMES])
    assert np.median(found[0][2][labels == SegmentationLabel.TABLE, 2]) == pytest.approx(0.92, abs=0.01)
    np.testing.assert_allclose(found[0][3], pose[:3], atol=1e-6)
    episode.close()
    shipped, _ = load_mask_predictor(find_vision_weights("segmentation", "s0"))
    guess = shipped(*found[0])
    np.testing.assert_array_equal(guess, shipped(*found[0]))
    assert shipped(found[0][0], np.full_like(found[0][1], 2.0), *found[0][2:]).shape == labels.shape
    # The network saw no other objects in its training, and takes some for the target.
    is_target = (labels == SegmentationLabel.TARGET) & np.isin(
        guess, (SegmentationLabel.TARGET, SegmentationLabel.HAND)
    )
    assert (guess[is_target] == SegmentationLabel.TARGET).mean() > 0.8 > (guess == SegmentationLabel.TARGET).mean()


def test_options() -> None:
    perfect, predicted = receivers.make("vision", DATA), receivers.make("vision:masks=predicted", DATA)
    assert (perfect.obs_mode, predicted.obs_mode) == ("scene_pointcloud", UNSEGMENTED)
    assert perfect.weights_hash == receivers.make("vision:masks=perfect", DATA).weights_hash != predicted.weights_hash
    with pytest.raises(OptionError, match=r"train_segmentation\.py --setup s1"):
        receivers.make("vision:masks=predicted", DATA, setup="s1")


def test_intersection_over_union_ignores_pixels_without_depth() -> None:
    truth = np.zeros((1, 32, 32), dtype=np.uint8)
    truth[0, 0, :8], truth[0, 1, :4], truth[0, 2] = 1, 3, 255
    guess = np.zeros((1, 32, 32), dtype=np.int64)
    guess[0, 0, :6], guess[0, 1, :8], guess[0, 2] = 1, 3, 1
    learner = SegmentationLearner(SegmentationNetwork(), 1, torch.device("cpu"))
    logits = torch.nn.functional.one_hot(torch.from_numpy(guess), 4).permute(0, 3, 1, 2)
    learner.averaged_network.forward = lambda *_: logits  # type: ignore[method-assign]
    depth = np.zeros((1, 32, 32), dtype=np.float16)
    batches = SegmentationBatches(SegmentationViews(np.zeros((1, 32, 32, 3), dtype=np.uint8), depth, depth, truth))
    n_rest = 32 * 32 - 32 - 12
    expected = {"background": (n_rest - 4) / (n_rest + 2), "target": 6 / 8, "other_object": 0.0, "hand": 4 / 8}
    assert learner.evaluate(batches) == pytest.approx(expected)
