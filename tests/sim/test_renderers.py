"""Who draws what the wrist camera shows."""

import importlib.util
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from handover_marl.config import OFFICIAL
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.sight import SightConfig
from handover_marl.errors import DataFormatError, OptionError, UnknownNameError
from handover_marl.sim.camera.photo import Photo
from handover_marl.sim.rays.ray_camera import RayCamera
from handover_marl.sim.renderers import EngineRenderer, RayRenderer, chosen_renderer, make_renderer
from handover_marl.sim.world import Snapshot, World

DATA = open_dataset("synthetic", robot="panda_camera")
SCENE = DATA.scene(209)
NOWHERE = Photo(np.ones((224, 224), dtype=np.float32), np.zeros((224, 224), dtype=np.uint8))


class AskedWorld:
    """Keeps what it is asked for."""

    def __init__(self, now: Snapshot) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self._now = now

    def snapshot(self) -> Snapshot:
        self.asked.append(("snapshot",))
        return self._now

    def photograph(self, color: bool, at: Snapshot | None = None) -> Photo:
        self.asked.append((color, at))
        return NOWHERE


def moment(shift: float = 0.0) -> Snapshot:
    start = np.array(OFFICIAL.physics.panda.start_joints, dtype=np.float32)
    start[0] += shift
    return Snapshot(start, SCENE.hand_dof[-1], SCENE.object_dof[-1])


def asked_world() -> tuple[AskedWorld, World]:
    world = AskedWorld(moment())
    return world, cast(World, world)


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    """Something is not installed."""
    find, missing = importlib.util.find_spec, str(request.param)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == missing else find(name, *rest))
    return missing


def test_automatically_the_engine_draws_exact_physics_and_rays_others() -> None:
    assert chosen_renderer("auto", "exact") == "bullet"
    assert chosen_renderer("auto", "fast") == "rays"
    for physics in ("exact", "fast"):
        assert chosen_renderer("bullet", physics) == "bullet"
        assert chosen_renderer("rays", physics) == "rays"


@pytest.mark.parametrize("name", ["", "Rays", "opengl"])
def test_unknown_renderers_are_refused(name: str) -> None:
    with pytest.raises(UnknownNameError, match=f"unknown renderer '{name}'; valid: auto, bullet, rays"):
        chosen_renderer(name, "exact")
    with pytest.raises(UnknownNameError, match="renderer"):
        chosen_renderer(name, "fast", installed=False)


def test_an_episode_with_an_unknown_renderer_shows_nothing() -> None:
    with pytest.raises(UnknownNameError, match="unknown renderer 'opengl'"):
        start(SightConfig(renderer="opengl")).look()


@pytest.mark.parametrize("without", ["embreex", "trimesh"], indirect=True)
def test_rays_without_their_extra_tell_what_to_do(without: str) -> None:
    for name, physics in (("rays", "exact"), ("rays", "fast"), ("auto", "fast")):
        with pytest.raises(OptionError, match=rf"{without}.*handover-marl\[vision\].*renderer='bullet'"):
            chosen_renderer(name, physics)
        assert chosen_renderer(name, physics, installed=False) == "rays"
    assert chosen_renderer("bullet", "fast") == "bullet"
    assert chosen_renderer("auto", "exact") == "bullet"


@pytest.mark.parametrize("without", ["embreex"], indirect=True)
def test_episodes_without_the_extra_are_played_until_somebody_looks(without: str) -> None:
    episode = start(SightConfig())
    episode.observe_sight(None)
    for look in (episode.look, lambda: episode.observe_sight("points")):
        with pytest.raises(OptionError, match=rf"{without}.*handover-marl\[vision\].*renderer='bullet'"):
            look()
    episode.close()
    assert start(SightConfig(renderer="bullet")).look().segmentation.any()


def test_nobody_needs_the_extra_who_lets_the_engine_draw() -> None:
    code = """
import sys
sys.modules["embreex"] = sys.modules["trimesh"] = None
import numpy as np
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.sight import SightConfig
for physics, renderer in (("exact", "auto"), ("fast", "bullet")):
    episode = Episode(physics, sight=SightConfig(renderer=renderer))
    episode.reset(open_dataset("synthetic").scene(209))
    assert episode.look().segmentation.any()
    assert episode.observe_sight("points")["wrist_point_counts"].shape == (2,)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def start(config: SightConfig) -> Episode:
    episode = Episode("fast", sight=config)
    episode.reset(SCENE)
    return episode


def test_the_engine_draws_the_whole_picture_of_the_moment_that_is_asked_for() -> None:
    renderer = make_renderer("bullet", SCENE, OFFICIAL.physics)
    assert isinstance(renderer, EngineRenderer)
    world, given = asked_world()
    at = moment(0.3)
    for color in (False, True):
        for when in (None, at):
            assert renderer.photograph(given, when, color) is NOWHERE
    assert renderer.sought(given, None) is renderer.sought(given, at) is NOWHERE
    expected = [(False, None), (False, at), (True, None), (True, at), (False, None), (False, at)]
    assert [(color, when is at) for color, when in world.asked] == [(color, when is at) for color, when in expected]


def test_rays_are_cast_at_the_moment_that_is_asked_for() -> None:
    renderer = make_renderer("rays", SCENE, OFFICIAL.physics)
    assert isinstance(renderer, RayRenderer)
    camera, (world, given), at = RayCamera(SCENE.assets, OFFICIAL.physics), asked_world(), moment(0.3)
    for when, expected in ((None, moment()), (at, at)):
        photo, part = renderer.photograph(given, when, color=True), renderer.sought(given, when)
        whole = camera.photograph(expected, color=True)
        np.testing.assert_array_equal(photo.depth, whole.depth)
        np.testing.assert_array_equal(photo.rgb, whole.rgb)
        np.testing.assert_array_equal(part.depth, camera.sought(expected).depth)
        assert part.rgb is renderer.photograph(given, when, color=False).rgb is None
    assert world.asked == [("snapshot",)] * 3
    assert (renderer.sought(given, None).depth != renderer.sought(given, at).depth).any()


def test_meshes_that_cannot_be_read_are_named_when_somebody_looks(tmp_path: Path) -> None:
    folder = shutil.copytree(SCENE.assets.objects[0].parent, tmp_path / "target")
    target = folder / SCENE.assets.objects[0].name
    episode = Episode("fast")
    episode.reset(replace(SCENE, assets=replace(SCENE.assets, objects=(target, *SCENE.assets.objects[1:]))))
    (folder / "textured_simple.obj").write_text("")
    for look in (episode.look, lambda: episode.observe_sight("points")):
        with pytest.raises(DataFormatError, match=r"target/textured_simple\.obj: the mesh is empty"):
            look()
    episode.close()
