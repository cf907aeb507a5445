import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.config import TABLE_HEIGHT, PandaConfig
from handover_marl.datasets.generated.dataset import GeneratedDataset
from handover_marl.datasets.generated.post_arrival_motion import (
    MAX_SPEED,
    MIN_HEIGHT,
    REACH,
    SHOULDER_HEIGHT,
    draw_far_positions,
)
from handover_marl.datasets.generated.random_stream import RandomStream


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "generated"))


@pytest.mark.parametrize("scene_id", range(4))
def test_objects_move_and_turn_for_eight_seconds(scene_id: int) -> None:
    scene = GeneratedDataset("n=10,seed=1,family=hard").load_scene(scene_id)
    assert scene.n_frames == 8001
    keyframes = scene.object_dof[::40, 0].astype(np.float64)
    rotations = Rotation.from_euler("XYZ", keyframes[:, 3:])
    turns = np.degrees((rotations[:-1].inv() * rotations[1:]).magnitude()) / 0.04
    # After the handover pose is reached, which takes about 3 s.
    assert 29.0 < turns[80:].max() < 91.0
    speeds = np.linalg.norm(np.diff(keyframes[:, :3], axis=0), axis=1) / 0.04
    assert speeds[80:].max() < MAX_SPEED + 0.02
    assert speeds[-4:].max() < 0.01
    # The hand holds the object in the same way all the time.
    hand = scene.hand_dof[::40].astype(np.float64)
    base = Rotation.from_euler("XYZ", hand[:, 3:6])
    offsets = rotations.inv().apply(hand[:, :3] - keyframes[:, :3])
    assert np.ptp(offsets[80:], axis=0).max() < 1e-4
    assert (rotations[80:].inv() * base[80:] * (rotations[80].inv() * base[80]).inv()).magnitude().max() < 1e-3


def test_offers_are_at_the_edge_of_reach() -> None:
    x, y, z = PandaConfig().base_position
    shoulder = np.array([x, y, z + SHOULDER_HEIGHT - TABLE_HEIGHT])
    for seed in range(50):
        handover = draw_far_positions(RandomStream(seed))[1]
        distance = np.linalg.norm(handover - shoulder)
        assert REACH[0] - 1e-9 < distance < REACH[1] + 1e-9 or handover[2] == MIN_HEIGHT
