"""Tests of the network that separates the points of object and hand, and of its training data."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from handover_marl.learning.imitation.vision.segmentation import (
    ObjectHandClouds,
    PointBatches,
    PointSegmentationLearner,
    SegmentationViews,
    collect_clouds,
)
from handover_marl.learning.networks.point_segmentation_network import N_BODY_POINTS, PointSegmentationNetwork
from handover_marl.learning.networks.segmentation_network import N_CLASSES, SegmentationNetwork
from handover_marl.receivers.vision.mask_predictor import HAND_CLASS, OBJECT_CLASS, choose_points
from handover_marl.simulation.camera.optics import deproject

SHAPE = (224, 224)


def make_clouds(count: int, seed: int = 0) -> ObjectHandClouds:
    """Make clouds of a ball, the hand, above a flat object."""
    rng = np.random.default_rng(seed)
    points = np.array([0.3, -0.2, 1.2]) + rng.normal(0.0, 0.02, (count, 768, 3))
    is_hand = rng.random((count, 768)) < 0.5
    points[..., 2] = np.where(is_hand, points[..., 2] + 0.08, 1.2)
    classes = np.where(is_hand, HAND_CLASS, OBJECT_CLASS).astype(np.uint8)
    margins, links = np.zeros((count, 768)), np.tile([0.3, 0.0, 1.3], (count, 1))
    return ObjectHandClouds(*(part.astype(np.float32) for part in (points, margins, links)), classes)


def test_the_place_on_the_table_does_not_matter_but_the_height_does() -> None:
    torch.manual_seed(0)
    network = PointSegmentationNetwork(N_CLASSES).eval()
    points, margins, links, _ = PointBatches(make_clouds(2)).select(np.arange(2))
    with torch.inference_mode():
        found = network(points, margins, links)
        assert found.shape == (2, N_BODY_POINTS, N_CLASSES)
        aside, up = torch.tensor([0.4, -0.3, 0.0]), torch.tensor([0.0, 0.0, 0.2])
        torch.testing.assert_close(network(points + aside, margins, links + aside), found, atol=1e-3, rtol=1e-3)
        assert not torch.allclose(network(points + up, margins, links + up), found, atol=1e-2)
        assert not torch.allclose(network(points, margins + 1.0, links), found, atol=1e-3)


@pytest.mark.slow
def test_a_short_training_separates_a_ball_from_a_plate() -> None:
    torch.manual_seed(0)
    learner = PointSegmentationLearner(PointSegmentationNetwork(N_CLASSES), 40, torch.device("cpu"))
    batches = PointBatches(make_clouds(20))
    for number in range(40):
        learner.update(batches.sample(4, np.random.default_rng(number)))
    shares = learner.evaluate(PointBatches(make_clouds(5, seed=1)))
    assert min(shares["target"], shares["hand"]) > 0.9


def test_clouds_have_the_heights_of_their_pixels() -> None:
    """A tilted camera sees a plane, of which the network takes the upper half for the hand."""
    depth = np.full(SHAPE, 0.6, dtype=np.float16) + np.linspace(0.0, 0.2, 224, dtype=np.float16)
    rotation, link = Rotation.from_euler("xy", [2.5, 0.3]).as_matrix(), np.array([0.1, 0.2, 1.4])
    heights = (deproject(depth.astype(np.float32), np.ones(SHAPE, dtype=np.bool_)) @ rotation.T + link)[:, 2]
    classes = np.full((1, *SHAPE), OBJECT_CLASS, dtype=np.uint8)
    rgb = np.zeros((1, *SHAPE, 3), dtype=np.uint8)
    views = SegmentationViews(rgb, depth[None], heights.reshape(1, *SHAPE).astype(np.float16), classes)
    logits, network = torch.zeros(1, N_CLASSES, *SHAPE), SegmentationNetwork()
    logits[:, OBJECT_CLASS], logits[:, HAND_CLASS, :112] = 1.0, 3.0
    network.forward = lambda *_: logits  # type: ignore[method-assign]
    clouds: Any = collect_clouds(network, views, np.random.default_rng(0))
    np.testing.assert_allclose(clouds.hand_links, [[0.0, 0.0, 1.4]], atol=0.01)
    assert set(np.unique(clouds.margins)) == {-1.0, 2.0}
    found = clouds.points[0, :, 2]
    assert heights.min() - 0.01 < found.min() < found.max() < heights.max() + 0.01
    assert np.linalg.norm(clouds.points[0] - clouds.hand_links[0], axis=1).min() > 0.55
    logits[:, 0] = 5.0
    assert collect_clouds(network, views, np.random.default_rng(0)) is None


def test_points_repeat_only_if_there_are_too_few() -> None:
    for available, distinct in ((3, 3), (256, 256), (5000, 256)):
        chosen = choose_points(available, N_BODY_POINTS, np.random.default_rng(0))
        assert (len(chosen), len(np.unique(chosen)), chosen.max() < available) == (N_BODY_POINTS, distinct, True)
