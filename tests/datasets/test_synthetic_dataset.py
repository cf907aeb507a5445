import hashlib

import numpy as np
import pytest

from handover_marl.assets.hand_model import SUBJECTS
from handover_marl.datasets.dataset import Scene
from handover_marl.datasets.splits import SETUPS, SPLIT_SIZES, SPLITS
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import SceneError

DATASET = SyntheticDataset()

#: First digits of the scenes' hashes: they change with the generator's version and with nothing else.
HASHES = {
    0: "06dd131ef32dedac",
    9: "aef853309b935107",
    105: "a13d76f0656255c1",
    209: "50354874eb6f409d",
    354: "697bd98a497fc3ea",
    499: "2d59ad1e1b6f37b2",
    640: "17aac7dd7e361bed",
    777: "2ab9a2aa1b9c5364",
    988: "aaa913eb1143dea9",
}


def digest(scene: Scene) -> str:
    info = repr(scene.info).replace(", side=", f", subject={scene.info.subject!r}, side=")
    content = scene.object_dof.tobytes() + scene.hand_dof.tobytes() + info.encode()
    return hashlib.sha256(content).hexdigest()[:16]


@pytest.mark.parametrize("scene_id", HASHES)
def test_scenes_equal_their_checksums(scene_id: int) -> None:
    assert digest(DATASET.load_scene(scene_id)) == HASHES[scene_id]


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("split", SPLITS)
def test_splits_have_the_official_sizes(setup: str, split: str) -> None:
    assert len(DATASET.list_scenes(setup, split)) == SPLIT_SIZES[setup, split]


@pytest.mark.parametrize("scene_id", range(0, 1000, 83))
def test_scenes_have_the_statistics_of_recordings(scene_id: int) -> None:
    scene = DATASET.load_scene(scene_id)
    assert (scene.n_frames - 1) % 80 == 40
    assert 65 <= (scene.n_frames - 1) / 40 <= 75
    assert scene.object_dof.dtype == scene.hand_dof.dtype == np.float32
    assert 3 <= len(scene.info.object_ids) <= 5
    assert len(set(scene.info.object_ids)) == len(scene.info.object_ids)
    assert scene.info.subject == f"synthetic-subject-{SUBJECTS[scene_id // 100]:02d}"
    assert scene.hand_first is not None
    assert scene.hand_first % 40 == 0
    assert not scene.hand_dof[: scene.hand_first].any()
    assert np.isfinite(scene.hand_dof).all()
    # Object and hand move at less than 5 m/s along each axis, and the other objects do not move.
    assert np.abs(np.diff(scene.object_dof[:, 0, :3], axis=0)).max() < 0.005
    assert np.abs(np.diff(scene.hand_dof[scene.hand_first :, :3], axis=0)).max() < 0.005
    assert not np.ptp(scene.object_dof[:, 1:], axis=0).any()
    assert all(path.is_file() for path in (*scene.assets.objects, scene.assets.hand, scene.assets.panda))


def test_scene_numbers() -> None:
    for ask in (DATASET.load_info, DATASET.load_scene, DATASET.find_side):
        with pytest.raises(SceneError, match="0 to 999"):
            ask(1000)
