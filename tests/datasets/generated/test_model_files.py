from pathlib import Path

import pytest

from handover_marl.datasets.generated.dataset import GeneratedDataset, write_hand_model
from handover_marl.datasets.generated.hands import draw_person
from handover_marl.errors import DataNotFoundError
from handover_marl.geometry.model_files.meshes import check_model, read_collision_mesh


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "handover_marl" / "generated"


def test_models_can_be_loaded(root: Path) -> None:
    dataset = GeneratedDataset("seed=2")
    for number in range(6):
        urdf = dataset.find_object_urdf(f"object_{number:05d}")
        check_model(urdf, n_joints=6)
        vertices, _ = read_collision_mesh(urdf)
        assert abs(vertices.min(axis=0) + vertices.max(axis=0)).max() < 2e-4
    person = draw_person(dataset.config, 3)
    check_model(write_hand_model(person, "left"), n_joints=51)
    assert not list(root.rglob("*.part"))


def test_models_are_written_once(root: Path) -> None:
    dataset = GeneratedDataset("seed=2")
    urdf = dataset.find_object_urdf("object_00001")
    before = urdf.stat().st_mtime_ns
    assert dataset.find_object_urdf("object_00001") == urdf
    assert urdf.stat().st_mtime_ns == before
    assert GeneratedDataset("seed=3").find_object_urdf("object_00001") != urdf


def test_folders_that_cannot_be_written_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "handover_marl").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(DataNotFoundError, match="set XDG_CACHE_HOME"):
        GeneratedDataset("seed=2").find_object_urdf("object_00001")
