"""Pictures and films of handovers, drawn without a screen."""

import importlib.util
import io
import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from rich.console import Console
from rich.progress import track

from handover_marl import receivers
from handover_marl.config import CameraConfig, ProtocolConfig
from handover_marl.datasets import open_dataset
from handover_marl.episode import Episode
from handover_marl.errors import OptionError
from handover_marl.files import write_atomically
from handover_marl.policy_clock import PolicyClock

Picture = npt.NDArray[np.uint8]

_NEEDED: dict[str, tuple[str, ...]] = {".png": (), ".gif": (), ".mp4": ("imageio", "imageio_ffmpeg")}

#: Kinds of files, by suffix.
SUFFIXES = tuple(_NEEDED)

_FILM_PERIOD_MS = 80
_SHEET_COLUMNS = 3
_BLANK_AFTER_MS = 500


def render_scene(
    scene_id: int,
    out: str | os.PathLike[str],
    *,
    dataset: str = "auto",
    data_dir: str | os.PathLike[str] | None = None,
    receiver: str | None = None,
    physics: str = "exact",
    key_frames: int = 6,
    camera: CameraConfig | None = None,
    progress: bool = True,
) -> Path:
    """Draw a scene, or the episode that a receiver makes of it.

    Args:
        scene_id: The scene, 0 to 999.
        out: Where to write: `.png` is a sheet of key frames, `.gif` and `.mp4` are films.
        dataset: "dexycb", "synthetic" or "auto".
        data_dir: Folder in HandoverSim's layout.
        receiver: Name of a receiver; None shows the recording with the robot at rest.
        physics: "exact" or "fast".
        key_frames: Pictures on a sheet.
        camera: Where to look from.
        progress: Whether to show a progress bar, on stderr.

    Returns:
        The file that was written.

    Raises:
        OptionError: The file's suffix is unknown, or a library for it is not installed.
        UnknownNameError, SceneError, DataNotFoundError, DataFormatError: As for a benchmark.
    """
    path = Path(out).expanduser()
    if path.suffix not in SUFFIXES:
        raise OptionError(
            f"{path}: cannot tell what to draw from {path.suffix!r}; end it in {', '.join(SUFFIXES)}"
        )
    if key_frames < 1:
        raise OptionError(f"key_frames={key_frames}: a sheet needs at least one")
    _check_installed(path.suffix)
    data = open_dataset(dataset, data_dir)
    policy = receivers.make(receiver or "hold", data)
    episode = Episode(physics)
    episode.reset(data.scene(scene_id))
    clock = PolicyClock(policy)
    clock.reset(scene_id)
    until = ProtocolConfig().horizon_steps if receiver else episode.scene.n_frames + _BLANK_AFTER_MS
    film = _film(episode, clock, until, camera or CameraConfig(), progress, path, key_frames)
    episode.close()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, film)
    return path


def _check_installed(suffix: str) -> None:
    for module in _NEEDED[suffix]:
        if importlib.util.find_spec(module) is None:
            raise OptionError(f"{suffix} files need {module}: pip install 'handover-marl[render]'")


def _film(
    episode: Episode,
    clock: PolicyClock,
    until: int,
    camera: CameraConfig,
    progress: bool,
    path: Path,
    key_frames: int,
) -> bytes:
    if path.suffix == ".png":
        times = np.linspace(0, until - 1, key_frames).astype(int).tolist()
    else:
        times = list(range(0, until, _FILM_PERIOD_MS))
    pictures = []
    for time in track(times, "drawing", console=Console(stderr=True), disable=not progress):
        _play_until(episode, clock, time)
        pictures.append(episode.render(camera))
        if episode.status:
            break
    return _sheet(pictures) if path.suffix == ".png" else _encode(pictures, path.suffix)


def _play_until(episode: Episode, clock: PolicyClock, time: int) -> None:
    while episode.steps < time and not episode.status:
        action = clock.act(episode.observe())
        episode.advance(action, min(clock.due_ms, time) - episode.steps)


def _sheet(pictures: list[Picture]) -> bytes:
    rows = [pictures[start : start + _SHEET_COLUMNS] for start in range(0, len(pictures), _SHEET_COLUMNS)]
    blank = np.full_like(pictures[0], 255)
    width = min(_SHEET_COLUMNS, len(pictures))
    full = [np.concatenate([*row, *[blank] * (width - len(row))], axis=1) for row in rows]
    image = Image.fromarray(np.concatenate(full))
    stream = io.BytesIO()
    image.save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def _encode(pictures: list[Picture], suffix: str) -> bytes:
    stream = io.BytesIO()
    if suffix == ".gif":
        first, *rest = [Image.fromarray(picture).quantize(64) for picture in pictures]
        first.save(
            stream,
            format="GIF",
            save_all=True,
            append_images=rest,
            duration=_FILM_PERIOD_MS,
            loop=0,
            optimize=True,
        )
        return stream.getvalue()
    import imageio.v3 as imageio

    return bytes(
        imageio.imwrite(
            "<bytes>", np.stack(pictures), extension=".mp4", fps=1000 / _FILM_PERIOD_MS, codec="libx264"
        )
    )
