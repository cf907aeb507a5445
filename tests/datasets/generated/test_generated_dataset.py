import hashlib

import numpy as np
import pytest

from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.datasets.generated.config import find_splits, parse_generated_config
from handover_marl.datasets.generated.dataset import FIRST_CLASS, GRASPABLE_CLASSES, GeneratedDataset
from handover_marl.errors import SceneError, UnknownNameError

DEFAULT, HARD = "generated:n=100000,seed=7", "generated:n=1000,seed=7,family=hard"
#: First digits of the scenes' hashes: they change with the generator's version and with nothing else.
HASHES = {
    (DEFAULT, 0): "fe045b563e40300d",
    (DEFAULT, 1): "255767c1a66e28a9",
    (DEFAULT, 99_999): "7ca60f4576b38de3",
    (HARD, 0): "aeecdeb25d27a94a",
    (HARD, 17): "41169280ea81b669",
}


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "generated"))


def digest(scene: Scene) -> str:
    info = repr(scene.info).replace(", side=", f", subject={scene.info.subject!r}, side=")
    content = scene.object_dof.tobytes() + scene.hand_dof.tobytes() + info.encode()
    return hashlib.sha256(content).hexdigest()[:16]


@pytest.mark.parametrize(("name", "scene_id"), HASHES)
def test_scenes_equal_their_checksums(name: str, scene_id: int) -> None:
    assert digest(open_dataset(name).load_scene(scene_id)) == HASHES[name, scene_id]


def test_scenes_depend_on_seed_and_number_alone() -> None:
    dataset = open_dataset(DEFAULT)
    first = digest(dataset.load_scene(17))
    for other in range(40, 46):
        dataset.load_scene(other)
    assert digest(dataset.load_scene(17)) == first
    assert digest(open_dataset("generated:n=18,seed=7").load_scene(17)) == first
    assert digest(open_dataset("generated:n=18,seed=8").load_scene(17)) != first
    assert digest(open_dataset("generated:n=18,seed=7,left=0.4").load_scene(17)) == first


def test_procedural_objects_differ_between_splits() -> None:
    dataset = GeneratedDataset("n=60,seed=1,procedural=1,objects=100")
    for scene_id in range(0, 60, 3):
        ids = dataset.load_info(scene_id).object_ids
        assert min(ids) >= FIRST_CLASS
        numbers = np.array(ids) - FIRST_CLASS
        assert (find_splits(numbers, of_objects=True) == find_splits([scene_id])).all()


def test_shipped_objects_only() -> None:
    dataset = GeneratedDataset("n=10,seed=1,procedural=0")
    ids = [dataset.load_info(scene_id).object_ids for scene_id in range(5)]
    assert {first for first, *_ in ids} <= {*GRASPABLE_CLASSES}
    assert max(max(numbers) for numbers in ids) < FIRST_CLASS


@pytest.mark.parametrize("name", [DEFAULT, HARD])
@pytest.mark.parametrize("scene_id", range(5, 8))
def test_scenes_are_complete(name: str, scene_id: int) -> None:
    dataset = open_dataset(name)
    scene = dataset.load_scene(scene_id)
    info = scene.info
    assert info.side == dataset.find_side(scene_id)
    assert info.object_names == tuple(dataset.object_names[number] for number in info.object_ids)
    assert len(set(info.object_ids)) == len(info.object_ids)
    assert scene.object_dof.dtype == scene.hand_dof.dtype == np.float32
    assert scene.object_dof.shape[1] == len(info.object_ids)
    assert np.isfinite(scene.hand_dof).all()
    assert np.abs(np.diff(scene.object_dof[:, 0, :3], axis=0)).max() < 0.005
    assert not np.ptp(scene.object_dof[:, 1:], axis=0).any()
    assert all(path.is_file() for path in (*scene.assets.objects, scene.assets.hand, scene.assets.panda))


def test_name_opens_the_data_set_again() -> None:
    dataset = open_dataset("generated:family=hard,seed=3,n=10")
    assert dataset.name == "generated:n=10,seed=3,family=hard"
    assert open_dataset(dataset.name).config == parse_generated_config("n=10,seed=3,family=hard")
    assert dataset.compute_fingerprint(1) == open_dataset("generated:n=99,seed=3,family=hard").compute_fingerprint(1)


def test_wrong_use_is_refused() -> None:
    with pytest.raises(SceneError, match="0 to 9"):
        open_dataset("generated:n=10").load_scene(10)
    with pytest.raises(UnknownNameError):
        open_dataset(DEFAULT).list_scenes("s0", "test")
    with pytest.raises(UnknownNameError):
        open_dataset(DEFAULT).find_object_urdf("object_01000")
