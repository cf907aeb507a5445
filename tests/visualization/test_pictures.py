"""Tests of pictures of the wrist camera's view, and of heat maps."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from handover_marl.cli import main
from handover_marl.config import CameraConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.visualization.pictures import draw_heat_map, draw_wrist_view
from tests.helpers.short_episodes import shorten_episodes

CAMERA = CameraConfig(width=320, height=240)


def near(pixels: np.ndarray, color: tuple[int, int, int]) -> int:
    return int((np.abs(pixels.astype(int) - color).max(axis=2) < 12).sum())


@pytest.mark.slow
def test_wrist_view() -> None:
    episode = Episode("fast")
    episode.reset(SyntheticDataset().load_scene(209))
    start = np.array(episode.config.physics.panda.start_joints, dtype=np.float32)
    before = draw_wrist_view(episode, CAMERA)
    episode.advance(start, 2500)
    picture = draw_wrist_view(episode, CAMERA)
    assert picture.shape == before.shape == (CAMERA.height + CAMERA.width // 3, CAMERA.width, 3)
    strip = picture[CAMERA.height :]
    assert near(strip, (228, 87, 46)) > 100, "the object"
    assert near(strip, (46, 134, 171)) > 20, "the hand"
    assert near(before[CAMERA.height :], (46, 134, 171)) < near(strip, (46, 134, 171))
    np.testing.assert_array_equal(draw_wrist_view(episode, CAMERA), picture)
    episode.close()


@pytest.mark.slow
def test_render_command_wrist_view(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 100)
    out = tmp_path / "wrist.png"
    command = ["render", "--scene", "209", "--dataset", "synthetic", "--view", "wrist", "--receiver", "hold"]
    assert main([*command, "--out", str(out), "--key-frames", "2", "--width", "160", "--height", "120"]) == 0
    assert str(out) in capsys.readouterr().out
    with Image.open(out) as image:
        assert image.size == (2 * 160, 120 + 160 // 3 - 1)


LONG = "cooperative:" + ",".join(f"option_{number}=0.123" for number in range(30))


@pytest.mark.filterwarnings("error")
def test_long_names_are_wrapped_and_cut_off() -> None:
    pytest.importorskip("matplotlib", reason="needs the extra `plot`")
    picture = Image.open(io.BytesIO(draw_heat_map([[0.5], [1.0]], ["replay", LONG], [LONG], "title")))
    assert max(picture.size) < 1500
