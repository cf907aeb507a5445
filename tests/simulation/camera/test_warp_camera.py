"""Tests of wrist cameras on a device, on Warp's CPU device, against the ray caster, and of the renderers' colors."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("torch", reason="needs the extra `warp`")
pytest.importorskip("warp", reason="needs the extra `warp`")
pytest.importorskip("embreex", reason="needs the extra `vision`")

from PIL import Image

from handover_marl.config import PandaConfig, PhysicsConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import OptionError
from handover_marl.geometry.arrays import make_tensor_factory, to_numpy
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.simulation.bullet.rendering import SceneRenderer
from handover_marl.simulation.camera.images import CameraImage, SegmentationLabel
from handover_marl.simulation.camera.optics import WRIST_CAMERA
from handover_marl.simulation.camera.ray_camera import RayCamera
from handover_marl.simulation.camera.warp_camera import ImageBatch, WarpCamera
from tests.simulation.camera.snapshots import draw_snapshot, place_in_view, stack_states

TENSORS = make_tensor_factory("cpu")
CONFIG = PhysicsConfig()
_MOVED = replace(
    PandaConfig(), base_position=(0.3, -0.3, 0.9), base_orientation=(0.1830127, 0.1830127, 0.6830127, 0.6830127)
)
#: Poses of robot and table by data set.
CONFIGS = {"synthetic": PhysicsConfig(panda=_MOVED, table_position=(0.35, 0.1, -0.1)), "several": CONFIG}
SHAPE = (224, 224)
TARGET, HAND = SegmentationLabel.TARGET, SegmentationLabel.HAND
Flags = npt.NDArray[np.bool_]


def load_scenes(request: pytest.FixtureRequest, data: str) -> list[Scene]:
    """Return three scenes of a data set, with different objects and hands."""
    if data == "synthetic":
        # Five, three and four objects.
        dataset, numbers = open_dataset("synthetic", robot=PANDA_CAMERA), (9, 209, 14)
    else:
        dataset, numbers = request.getfixturevalue("several_objects"), (0, 5, 7)
    return [dataset.load_scene(number) for number in numbers]


def make_cameras(scenes: list[Scene], config: PhysicsConfig = CONFIG) -> tuple[WarpCamera, list[RayCamera]]:
    camera = WarpCamera(config, len(scenes), TENSORS)
    for row, scene in enumerate(scenes):
        camera.load_scene(row, scene.assets)
    return camera, [RayCamera(scene.assets, config) for scene in scenes]


def compare(found: ImageBatch, row: int, expected: CameraImage) -> npt.NDArray[np.int_]:
    """Compare an image with one of the processor; return the number of its pixels by label."""
    labels = to_numpy(found.segmentation[row]).reshape(SHAPE)
    same: Flags = labels == expected.segmentation
    assert same.mean() >= 0.9995
    depth = to_numpy(found.depth[row]).reshape(SHAPE)
    assert depth.dtype == np.float32
    # At an edge between two links of one body, a ray may hit the other link.
    assert (np.abs(depth - expected.depth)[same] < 1e-4).mean() >= 0.9995
    if expected.rgb is not None and found.rgb is not None:
        colors = to_numpy(found.rgb[row]).reshape(*SHAPE, 3).astype(int)
        assert (np.abs(colors - expected.rgb)[same] <= 1).mean() >= 0.999
    return np.bincount(expected.segmentation.ravel(), minlength=len(SegmentationLabel))


@pytest.mark.slow
@pytest.mark.parametrize("data", CONFIGS)
def test_images_equal_those_of_the_processor(request: pytest.FixtureRequest, data: str) -> None:
    scenes, config, rng = load_scenes(request, data), CONFIGS[data], np.random.default_rng(0)
    camera, singles = make_cameras(scenes, config)
    rows, counts = TENSORS.arange(len(scenes)), np.zeros(len(SegmentationLabel), dtype=int)
    now = [draw_snapshot(scene, config, rng, has_hand=row > 0) for row, scene in enumerate(scenes)]
    batch = stack_states(now, TENSORS)
    images = camera.render(rows, batch, color=True)
    labels = [SegmentationLabel.TARGET, SegmentationLabel.HAND, SegmentationLabel.OTHER_OBJECT]
    targets, objects = (camera.render(rows, batch, False, labels=labels[:count]) for count in (2, 3))
    for row, (single, own) in enumerate(zip(singles, now, strict=True)):
        counts += compare(images, row, single.render(own, True))
        compare(targets, row, single.render_targets(own))
        compare(objects, row, single.render_targets(own, with_others=True))
        assert own.hand is not None or not (images.segmentation[row] == HAND).any()
    assert counts.min() > 400
    # Images do not depend on the other worlds.
    some = camera.render(TENSORS.asarray([2, 0]), stack_states([now[2], now[0]], TENSORS), color=True)
    for found, expected in zip(some, images, strict=True):
        np.testing.assert_array_equal(found, expected[[2, 0]])
    camera.close()


@pytest.mark.slow
def test_worlds_change_their_scenes(request: pytest.FixtureRequest) -> None:
    """A world that had more objects before has those of its present scene only; models are copied once."""
    scenes, rng = load_scenes(request, "synthetic"), np.random.default_rng(4)
    camera, singles = make_cameras(scenes)
    assert camera._mesh_buffers is not None
    n_meshes = len(camera._mesh_buffers._meshes)
    camera.load_scene(0, scenes[1].assets)
    assert len(camera._mesh_buffers._meshes) == n_meshes
    now = draw_snapshot(scenes[1], CONFIG, rng, nearest=0.3)
    # A target around the camera shows back faces only, which are invisible.
    now.objects[0, :3] = place_in_view(scenes[1], CONFIG, now.robot, [0.0, 0.0, 0.0])
    images = camera.render(TENSORS.arange(1), stack_states([now], TENSORS), color=False)
    assert images.rgb is None
    compare(images, 0, singles[1].render(now, False))
    assert not (images.segmentation[0] == TARGET).any()

    with pytest.raises(OptionError, match="all robots must have the same joints with backend='warp'"):
        camera.load_scene(0, replace(scenes[0].assets, panda=scenes[0].assets.hand))


def sample(masks: list[Flags], seeds: list[int], steps: list[int], stream_id: int = 0) -> npt.NDArray[np.int_]:
    """Sample 1,024 pixels of images in which the pixels of masks (50176,) show the target."""
    segmentation = TENSORS.asarray(np.where(np.stack(masks), int(TARGET), int(HAND)), "uint8")
    images = ImageBatch(TENSORS.zeros(segmentation.shape, "float32"), segmentation, None)
    own = TENSORS.asarray(seeds, "int64"), TENSORS.asarray(steps, "int64")
    return to_numpy(WarpCamera(CONFIG, 1, TENSORS).sample_pixels(images, TARGET, 1024, *own, stream_id))


def test_pixels_are_chosen_at_random_without_replacement() -> None:
    rng = np.random.default_rng(0)
    masks = [rng.permutation(WRIST_CAMERA.n_pixels) < count for count in (0, 1, 700, 1024)]
    for mask, chosen in zip(masks, sample(masks, [1, 2, 3, 4], [0, 1, 2, 3]), strict=True):
        expected = np.flatnonzero(mask)
        np.testing.assert_array_equal(chosen[: len(expected)], expected)
        assert (chosen[len(expected) :] == WRIST_CAMERA.n_pixels).all()
    assert sample([np.arange(300) < 2], [1], [0])[0].tolist() == [0, 1] + [300] * 1022, "an image with few pixels"
    mask = rng.random(WRIST_CAMERA.n_pixels) < 0.5
    found = sample([mask] * 64, list(range(64)), [7] * 64)
    assert mask[found].all()
    assert (np.diff(found, axis=1) > 0).all()
    # Each tenth of the pixels has a tenth of the chosen ones: 6554 with a standard deviation of 76.
    counts, _ = np.histogram(np.cumsum(mask)[found], bins=10, range=(0, mask.sum()))
    assert np.abs(counts - 6554).max() < 350


def test_choices_depend_on_seed_steps_and_stream_only() -> None:
    mask = np.arange(WRIST_CAMERA.n_pixels) % 3 == 0
    seeds, steps = [5, 6, 5, 2**32 - 1], [100, 100, 200, 13_000]
    found = sample([mask] * 4, seeds, steps)
    for row in range(4):
        np.testing.assert_array_equal(sample([mask], [seeds[row]], [steps[row]])[0], found[row])
    drawn = [*found, *sample([mask], [5], [100], stream_id=1)]
    # Two independent choices of 1,024 of 16,726 pixels share 63 in the mean.
    shared = [len(np.intersect1d(drawn[k], drawn[n])) for k in range(5) for n in range(k)]
    assert max(shared) < 120


#: Pixels of a label below which single pixels at edges change the mean.
MIN_PIXELS = 100
#: A box with a picture that repeats on some sides, a second picture, and corners without a place in the picture.
BOX = """mtllib box.mtl
o first
v -0.05 -0.05 -0.05\nv 0.05 -0.05 -0.05\nv 0.05 0.05 -0.05\nv -0.05 0.05 -0.05
v -0.05 -0.05 0.05\nv 0.05 -0.05 0.05\nv 0.05 0.05 0.05\nv -0.05 0.05 0.05
vt 0 0\nvt 1.5 0\nvt 1.5 2\nvt -0.3 0.8
usemtl plain
f 1/1 4/2 3/3 2/4
f 5/1 6/2 7/3 8/4
usemtl picture
f 1/-4 2/-3 6/-2 5/-1
o second
usemtl other
f 2/1 3/2 7/3 6/4
f 3/1 4/2 8/3 7/4
f 4 1 5 8
"""
MATERIALS = """newmtl plain\nKd 0 0 1\nnewmtl picture\nKd 0.2 0.2 0.2\nmap_Kd first.png
newmtl other\nmap_Kd second.png
"""


def make_textured_scene(scene: Scene, folder: Path) -> Scene:
    """Return the scene with an object of the user's that has textures and a material."""
    own = folder / "own"
    shutil.copytree(scene.assets.objects[0].parent, own)
    urdf = own / scene.assets.objects[0].name
    urdf.write_text(urdf.read_text().replace('rgba="1 1 1 1"', 'rgba="0.9 0.5 1 1"'))
    (own / "textured_simple.obj").write_text(BOX)
    (own / "box.mtl").write_text(MATERIALS)
    rng = np.random.default_rng(0)
    for name, size in (("first", (5, 3, 4)), ("second", (2, 2, 3))):
        Image.fromarray(rng.integers(0, 256, size, dtype=np.uint8)).save(own / f"{name}.png")
    return replace(scene, assets=replace(scene.assets, objects=(urdf, *scene.assets.objects[1:])))


def load_colored_scenes(request: pytest.FixtureRequest, data: str, folder: Path) -> list[Scene]:
    if data == "real":
        dataset = request.getfixturevalue("real_dataset")
        return [dataset.load_scene(scene) for scene in dataset.list_scenes("s0", "val")[:60:30]]
    return [make_textured_scene(open_dataset("synthetic", robot=PANDA_CAMERA).load_scene(14), folder)]


def compute_means(
    rgb: npt.NDArray[np.uint8], segmentation: npt.NDArray[np.uint8]
) -> dict[SegmentationLabel, npt.NDArray[np.float64]]:
    """Return the mean colors (3,) of the labels with enough pixels."""
    masks = {label: segmentation == label for label in SegmentationLabel}
    return {label: rgb[mask].mean(axis=0) for label, mask in masks.items() if mask.sum() >= MIN_PIXELS}


@pytest.mark.slow
@pytest.mark.parametrize("data", ["own", "real"])
def test_renderers_draw_the_same_colors(request: pytest.FixtureRequest, tmp_path: Path, data: str) -> None:
    rng, compared = np.random.default_rng(0), dict.fromkeys(SegmentationLabel, 0)
    scenes = load_colored_scenes(request, data, tmp_path)
    for scene in scenes:
        bullet, rays = SceneRenderer(scene, CONFIG), RayCamera(scene.assets, CONFIG)
        device = WarpCamera(CONFIG, 1, TENSORS)
        device.load_scene(0, scene.assets)
        for _ in range(4):
            now = draw_snapshot(scene, CONFIG, rng)
            drawn = bullet.render(now, color=True)
            cast = rays.render(now, color=True)
            images = device.render(TENSORS.arange(1), stack_states([now], TENSORS), color=True)
            assert drawn.rgb is not None
            assert cast.rgb is not None
            own_rgb, own_labels = (to_numpy(values[0]) for values in (images.rgb, images.segmentation))
            expected = compute_means(drawn.rgb, drawn.segmentation)
            for means in (compute_means(cast.rgb, cast.segmentation), compute_means(own_rgb, own_labels)):
                for label in means.keys() & expected.keys():
                    np.testing.assert_allclose(means[label], expected[label], rtol=0, atol=5.0, err_msg=label.name)
                    compared[label] += 1
        bullet.close()
        device.close()
    several = data != "real"
    assert all(compared[label] or (label == SegmentationLabel.OTHER_OBJECT and not several) for label in compared)


def test_textures_are_drawn_in_place(tmp_path: Path) -> None:
    """Pixel for pixel, a textured object has the colors that PyBullet draws, except at edges of the texture."""
    scene = make_textured_scene(open_dataset("synthetic", robot=PANDA_CAMERA).load_scene(14), tmp_path)
    bullet, rays, rng = SceneRenderer(scene, CONFIG), RayCamera(scene.assets, CONFIG), np.random.default_rng(1)
    shown = 0
    for _ in range(3):
        now = draw_snapshot(scene, CONFIG, rng, nearest=0.15)
        drawn, cast = (camera.render(now, True) for camera in (bullet, rays))
        assert drawn.rgb is not None
        assert cast.rgb is not None
        both = drawn.compute_mask(SegmentationLabel.TARGET) & cast.compute_mask(SegmentationLabel.TARGET)
        assert not both.any() or (np.abs(drawn.rgb.astype(int) - cast.rgb)[both].max(axis=1) <= 2).mean() > 0.97
        shown += int(both.sum())
    assert shown > 1000
    bullet.close()
