"""Tests of the colours of wrist-camera images, which are the same with every renderer."""

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

from handover_marl.config import PhysicsConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.arrays import make_tensor_factory, to_numpy
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.simulation.bullet.rendering import SceneRenderer
from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.simulation.camera.ray_camera import RayCamera
from handover_marl.simulation.camera.warp_camera import WarpCamera
from tests.simulation.camera.snapshots import draw_snapshot, stack_states

TENSORS = make_tensor_factory("cpu")
CONFIG = PhysicsConfig()
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


def load_scenes(request: pytest.FixtureRequest, data: str, folder: Path) -> list[Scene]:
    if data == "real":
        dataset = request.getfixturevalue("real_dataset")
        return [dataset.load_scene(scene) for scene in dataset.list_scenes("s0", "val")[:60:30]]
    return [make_textured_scene(open_dataset("synthetic", robot=PANDA_CAMERA).load_scene(14), folder)]


def compute_means(
    rgb: npt.NDArray[np.uint8], segmentation: npt.NDArray[np.uint8]
) -> dict[SegmentationLabel, npt.NDArray[np.float64]]:
    """Return the mean colours (3,) of the labels with enough pixels."""
    masks = {label: segmentation == label for label in SegmentationLabel}
    return {label: rgb[mask].mean(axis=0) for label, mask in masks.items() if mask.sum() >= MIN_PIXELS}


@pytest.mark.slow
@pytest.mark.parametrize("data", ["own", "real"])
def test_renderers_draw_the_same_colours(request: pytest.FixtureRequest, tmp_path: Path, data: str) -> None:
    rng, compared = np.random.default_rng(0), dict.fromkeys(SegmentationLabel, 0)
    scenes = load_scenes(request, data, tmp_path)
    for scene in scenes:
        bullet, rays, device = (
            SceneRenderer(scene, CONFIG),
            RayCamera(scene.assets, CONFIG),
            WarpCamera(CONFIG, 1, TENSORS),
        )
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
    """Pixel for pixel, a textured object has the colours that PyBullet draws, except at edges of the texture."""
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
