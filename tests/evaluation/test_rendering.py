from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from handover_marl import givers, receivers
from handover_marl.cli import main, runs
from handover_marl.config import CameraConfig, ProtocolConfig, WorldConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.errors import HandoverError, OptionError, UnknownNameError
from handover_marl.evaluation import rendering as scene_rendering
from handover_marl.evaluation.rendering import render_scene
from handover_marl.visualization import pictures as drawing
from tests.helpers.playing import StepRecorder

CAMERA = CameraConfig(width=96, height=72)


def draw(out: Path, **options: Any) -> Path:
    chosen = {"dataset": "synthetic", "physics": "fast", "camera": CAMERA, "progress": False, **options}
    return render_scene(209, out, **chosen)


def pictures(sheet: Path) -> list[np.ndarray]:
    """Return the images of a contact sheet, without the white cells that fill its last row."""
    with Image.open(sheet) as image:
        pixels = np.asarray(image)
    rows, columns = pixels.shape[0] // CAMERA.height, pixels.shape[1] // CAMERA.width
    assert pixels.shape == (rows * CAMERA.height, columns * CAMERA.width, 3)
    cells = [part for row in np.split(pixels, rows) for part in np.split(row, columns, axis=1)]
    shown = [not (part == 255).all() for part in cells]
    assert shown == sorted(shown, reverse=True)
    return [part for part, there in zip(cells, shown, strict=True) if there]


@pytest.mark.slow
def test_key_frames_span_the_episode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps, render = [], Episode.render

    def noted(episode: Episode, camera: CameraConfig) -> Any:
        steps.append(episode.steps)
        return render(episode, camera)

    monkeypatch.setattr(Episode, "render", noted)
    # The time limit of the rules does not end a scene without a receiver.
    short = WorldConfig(protocol=ProtocolConfig(horizon_steps=300))
    shown = pictures(draw(tmp_path / "new" / "sheet.png", key_frames=4, world_config=short))
    end = SyntheticDataset().load_scene(209).n_frames + 500
    assert steps == np.linspace(0, end, 4).round().astype(int).tolist()
    assert len(shown) == 4
    assert shown[0].std() > 20
    assert (shown[0] != shown[3]).any(axis=2).mean() > 0.003


@pytest.mark.slow
def test_rendering_does_not_change_the_episode() -> None:
    """Outcome and joints do not depend on when images are rendered, of a robot that moves at random."""
    dataset = SyntheticDataset()
    players = receivers.make("random", dataset), givers.make("noisy", dataset)
    ends = []
    for times in (range(0), range(0, 700, 80)):
        episode, joints = Episode("exact"), StepRecorder(lambda now: now.world.read_joint_snapshot().robot)
        episode.reset(dataset.load_scene(209))
        recorder = drawing.FrameRecorder(times, lambda now: now.render(CAMERA))
        run_episode(episode, *players, seed=0, until=700, callbacks=[joints, recorder])
        ends.append((episode.status, episode.steps, np.array(joints.rows)))
        episode.close()
    (*end, rows), (*other, same) = ends
    np.testing.assert_array_equal(same, rows)
    assert other == end


@pytest.mark.slow
def test_videos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra `render`")
    for module in (drawing, scene_rendering):
        monkeypatch.setattr(module, "FRAME_PERIOD_MS", 800)
    assert draw(tmp_path / "video.mp4").read_bytes()[4:8] == b"ftyp"
    with Image.open(draw(tmp_path / "video.gif")) as video:
        assert (video.format, video.size) == ("GIF", (96, 72))
        assert video.n_frames >= 3


@pytest.mark.parametrize(
    ("out", "options", "error"),
    [
        ("x.bmp", {}, OptionError),
        ("x.png", {"key_frames": 0}, OptionError),
        ("x.png", {"receiver": "nobody"}, UnknownNameError),
        ("x.png", {"setup": "s4"}, UnknownNameError),
        ("x.png", {"camera": CameraConfig(link="panda_hand")}, OptionError),
    ],
)
def test_bad_options(tmp_path: Path, out: str, options: dict[str, object], error: type[HandoverError]) -> None:
    with pytest.raises(error):
        draw(tmp_path / out, **options)
    assert not list(tmp_path.iterdir())


def test_camera_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(runs, "render_scene", lambda *_, **options: calls.append(options))
    command = ["render", "--scene", "209", "--dataset", "synthetic", "--out", str(tmp_path / "x.png")]
    place = ["--position", "1.0", "-0.5", "2.0", "--target", "0.4", "0", "1.1", "--vertical-fov", "30"]
    assert main([*command, *place, "--width", "320", "--no-caption"]) == 0
    assert main(command) == 0
    camera = CameraConfig(width=320, position=(1.0, -0.5, 2.0), target=(0.4, 0.0, 1.1), vertical_fov=30.0)
    assert [(options["camera"], options["caption"]) for options in calls] == [(camera, False), (CameraConfig(), True)]
