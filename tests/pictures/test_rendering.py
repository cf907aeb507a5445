from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from handover_marl import rendering
from handover_marl.cli import main
from handover_marl.config import CameraConfig
from handover_marl.errors import HandoverError, OptionError, SceneError, UnknownNameError
from handover_marl.pictures.rendering import render_scene

CAMERA = CameraConfig(width=96, height=72)


def draw(out: Path, **options: object) -> Path:
    return render_scene(209, out, dataset="synthetic", camera=CAMERA, progress=False, **options)  # type: ignore[arg-type]


def test_a_sheet_of_key_frames(tmp_path: Path) -> None:
    with Image.open(draw(tmp_path / "new" / "sheet.png", key_frames=4)) as sheet:
        pixels = np.asarray(sheet)
    assert pixels.shape == (2 * 72, 3 * 96, 3)
    first, second = pixels[:72, :96], pixels[72:, :96]
    assert first.std() > 20
    assert (first != second).any(axis=2).mean() > 0.003
    assert (pixels[72:, 96:] == 255).all()


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_films(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg", reason="needs the extra `render`")
    monkeypatch.setattr(rendering, "_FILM_PERIOD_MS", 800)
    path = draw(tmp_path / f"film{suffix}")
    head = path.read_bytes()[:12]
    assert head.startswith(b"GIF89a") if suffix == ".gif" else head[4:8] == b"ftyp"
    if suffix == ".gif":
        with Image.open(path) as film:
            assert film.n_frames >= 3
            assert film.size == (96, 72)


def test_an_episode_goes_on_until_it_ends(tmp_path: Path) -> None:
    path = draw(tmp_path / "episode.png", receiver="yang2021", key_frames=4)
    with Image.open(path) as sheet:
        pixels = np.asarray(sheet)
    assert (pixels[:72, :96] != pixels[:72, 96:192]).any(axis=2).mean() > 0.02


@pytest.mark.parametrize(
    ("out", "options", "error"),
    [
        ("x.bmp", {}, OptionError),
        ("x", {}, OptionError),
        ("x.png", {"key_frames": 0}, OptionError),
        ("x.png", {"receiver": "nobody"}, UnknownNameError),
    ],
)
def test_bad_options(tmp_path: Path, out: str, options: dict[str, object], error: type[HandoverError]) -> None:
    with pytest.raises(error):
        draw(tmp_path / out, **options)
    assert not list(tmp_path.iterdir())


def test_missing_libraries_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(OptionError, match=r"\.mp4 files need imageio: pip install 'handover-marl\[render\]'"):
        draw(tmp_path / "x.mp4")


def test_scene_numbers(tmp_path: Path) -> None:
    with pytest.raises(SceneError):
        render_scene(1000, tmp_path / "x.png", dataset="synthetic", progress=False)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["render", "--scene", "33", "--dataset", "synthetic", "--out", str(tmp_path / "x.png")]
    assert main([*command, "--key-frames", "1", "--width", "64", "--height", "48"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "x.png")
    assert main([*command[:-1], str(tmp_path / "x.tiff")]) == 2
    assert ".tiff" in capsys.readouterr().err
