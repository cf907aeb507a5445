"""Tests of damaged collision meshes, which every physics engine refuses."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.episode import Episode
from handover_marl.errors import DataFormatError
from handover_marl.geometry.model_files.urdf import list_mesh_references

DAMAGES: dict[str, Callable[[str], str]] = {
    "empty": lambda text: "",
    "half": lambda text: text[: len(text) // 2].rpartition("\n")[0],
    "not finite": lambda text: text.replace("v ", "v nan ", 1),
}


def damage(scene: Scene, body: str, folder: Path, change: Callable[[str], str]) -> Scene:
    """Return a scene in which all meshes of a body are changed copies."""
    assets = scene.assets
    urdf: Path = assets.objects[0] if body == "object" else getattr(assets, body)
    copy = folder / "models" / urdf.parent.name / urdf.name
    copy.parent.mkdir(parents=True)
    copy.write_text(urdf.read_text())
    for (_, mesh), (_, target) in zip(list_mesh_references(urdf), list_mesh_references(copy), strict=True):
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(change(mesh.read_text()))
    changed = {"objects": (copy, *assets.objects[1:])} if body == "object" else {body: copy}
    return replace(scene, assets=replace(assets, **changed))  # type: ignore[arg-type]


@pytest.mark.parametrize("physics", ["exact", "fast", "mujoco"])
@pytest.mark.parametrize("body", ["object", "hand"])
@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_collision_meshes_are_refused(physics: str, body: str, kind: str, tmp_path: Path) -> None:
    if kind == "half" and body == "object":
        pytest.skip("half of an object's convex parts are a valid model")
    scene = damage(open_dataset("synthetic").load_scene(209), body, tmp_path, DAMAGES[kind])
    episode = Episode(physics)
    with pytest.raises(DataFormatError, match=r"\.obj"):
        episode.reset(scene)
    episode.close()
