"""Tests of the choice of the wrist camera's renderer."""

import importlib.util
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from handover_marl.datasets import open_dataset
from handover_marl.episode.camera_observations import WristCameraConfig
from handover_marl.episode.episode import Episode
from handover_marl.errors import DataFormatError, OptionError, UnknownNameError
from handover_marl.simulation.camera.renderers import resolve_renderer

DATA = open_dataset("synthetic", robot="panda_camera")
SCENE = DATA.load_scene(209)


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    """Pretend that a package is not installed."""
    find, missing = importlib.util.find_spec, str(request.param)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == missing else find(name, *rest))
    return missing


def test_auto_is_bullet_in_exact_physics_and_rays_in_others() -> None:
    assert resolve_renderer("auto", "exact") == "bullet"
    assert resolve_renderer("auto", "fast") == "rays"
    for physics in ("exact", "fast"):
        assert resolve_renderer("bullet", physics) == "bullet"
        assert resolve_renderer("rays", physics) == "rays"


@pytest.mark.parametrize("name", ["", "Rays", "opengl"])
def test_unknown_renderers_are_refused(name: str) -> None:
    with pytest.raises(UnknownNameError, match=f"unknown renderer '{name}'; valid: auto, bullet, rays"):
        resolve_renderer(name, "exact")
    with pytest.raises(UnknownNameError, match="renderer"):
        WristCameraConfig(renderer=name)


@pytest.mark.parametrize("without", ["embreex", "trimesh"], indirect=True)
def test_missing_packages_of_the_ray_caster_are_reported(without: str) -> None:
    for name, physics in (("rays", "exact"), ("rays", "fast"), ("auto", "fast")):
        with pytest.raises(OptionError, match=rf"{without}.*handover-marl\[vision\].*renderer='bullet'"):
            resolve_renderer(name, physics)
    assert resolve_renderer("bullet", "fast") == "bullet"
    assert resolve_renderer("auto", "exact") == "bullet"


@pytest.mark.slow
def test_the_bullet_renderer_needs_no_extra() -> None:
    code = """
import sys
sys.modules["embreex"] = sys.modules["trimesh"] = None
import numpy as np
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.camera_observations import WristCameraConfig
for physics, renderer in (("exact", "auto"), ("fast", "bullet")):
    episode = Episode(physics, wrist_camera=WristCameraConfig(renderer=renderer))
    episode.reset(open_dataset("synthetic").load_scene(209))
    assert episode.capture_wrist_camera().segmentation.any()
    assert episode.observe_camera("pointcloud")["wrist_point_counts"].shape == (2,)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def start(config: WristCameraConfig) -> Episode:
    episode = Episode("fast", wrist_camera=config)
    episode.reset(SCENE)
    return episode


def test_unreadable_meshes_are_reported_at_the_first_image(tmp_path: Path) -> None:
    folder = shutil.copytree(SCENE.assets.objects[0].parent, tmp_path / "target")
    target = folder / SCENE.assets.objects[0].name
    episode = Episode("fast")
    episode.reset(replace(SCENE, assets=replace(SCENE.assets, objects=(target, *SCENE.assets.objects[1:]))))
    (folder / "textured_simple.obj").write_text("")
    for look in (episode.capture_wrist_camera, lambda: episode.observe_camera("pointcloud")):
        with pytest.raises(DataFormatError, match=r"target/textured_simple\.obj: the mesh is empty"):
            look()
    episode.close()
