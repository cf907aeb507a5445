"""Tests of the choice of the wrist camera's renderer."""

import importlib.util
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.errors import DataFormatError, OptionError, UnknownNameError
from handover_marl.simulation.camera.renderers import resolve_renderer

DATA = open_dataset("synthetic", robot="panda_camera")
SCENE = DATA.load_scene(209)


def test_auto_is_bullet_in_exact_physics_and_rays_in_others() -> None:
    assert resolve_renderer("auto", "exact") == "bullet"
    assert resolve_renderer("auto", "fast") == "rays"
    for physics in ("exact", "fast"):
        assert resolve_renderer("bullet", physics) == "bullet"
        assert resolve_renderer("rays", physics) == "rays"


def test_renderers_that_cannot_be_used_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnknownNameError, match="unknown renderer 'Rays'; valid: auto, bullet, rays"):
        resolve_renderer("Rays", "exact")
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "embreex" else find(name, *rest)
    )
    with pytest.raises(OptionError, match=r"embreex.*handover-marl\[vision\].*renderer='bullet'"):
        resolve_renderer("auto", "fast")
    assert resolve_renderer("auto", "exact") == "bullet"


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
