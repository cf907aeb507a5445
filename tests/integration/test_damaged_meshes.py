"""Tests of damaged collision meshes and of impossible numbers in URDF files, which every physics engine refuses."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.episode import Episode
from handover_marl.errors import DataFormatError, HandoverError
from handover_marl.geometry.model_files.urdf import list_mesh_references
from handover_marl.simulation.engines import list_available_physics

DAMAGES: dict[str, Callable[[str], str]] = {
    "empty": lambda text: "",
    "half": lambda text: text[: len(text) // 2].rpartition("\n")[0],
    "flat": lambda text: "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
}


def keep(text: str) -> str:
    """Return the text."""
    return text


def damage(
    scene: Scene, body: str, folder: Path, change: Callable[[str], str], change_urdf: Callable[[str], str] = keep
) -> Scene:
    """Return a scene in which URDF and all meshes of a body are changed copies."""
    assets = scene.assets
    urdf: Path = assets.objects[0] if body == "object" else getattr(assets, body)
    copy = folder / "models" / urdf.parent.name / urdf.name
    copy.parent.mkdir(parents=True)
    copy.write_text(change_urdf(urdf.read_text()))
    for (_, mesh), (_, target) in zip(list_mesh_references(urdf), list_mesh_references(copy), strict=True):
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(change(mesh.read_text()))
    changed = {"objects": (copy, *assets.objects[1:])} if body == "object" else {body: copy}
    return replace(scene, assets=replace(assets, **changed))  # type: ignore[arg-type]


def assert_refused(scene: Scene, physics: str, error: type[HandoverError], message: str) -> None:
    episode = Episode(physics)
    with pytest.raises(error, match=message):
        episode.reset(scene)
    episode.close()


@pytest.mark.parametrize(("kind", "body"), [("empty", "object"), ("half", "hand"), ("flat", "object")])
def test_damaged_collision_meshes_are_refused(kind: str, body: str, tmp_path: Path) -> None:
    scene = damage(open_dataset("synthetic").load_scene(209), body, tmp_path, DAMAGES[kind])
    for physics in list_available_physics():
        assert_refused(scene, physics, DataFormatError, r"\.obj")


@pytest.mark.parametrize(
    ("body", "name", "number"),
    [("object", 'mass value="', "nan"), ("panda", 'izz="', "1e30"), ("object", 'scale="', "0 1 1")],
)
def test_impossible_numbers_are_refused(body: str, name: str, number: str, tmp_path: Path) -> None:
    def change(text: str) -> str:
        start, _, end = text.rpartition(name)
        assert start
        return "".join([start, name, number, end[end.index('"') :]])

    scene = damage(open_dataset("synthetic").load_scene(209), body, tmp_path, keep, change)
    for physics in list_available_physics():
        assert_refused(scene, physics, HandoverError, r"\.urdf: .* must be a number from")
