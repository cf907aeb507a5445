"""Recording of frames of an episode, their captions, and their encoding as an image grid or a video."""

import io
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.progress import Progress

from handover_marl.config import TIME_STEP
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import EpisodeCallback
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, ResultsError
from handover_marl.execution.options import check_path, require_modules

Picture = npt.NDArray[np.uint8]

#: Suffixes of all kinds of output files.
SUFFIXES = (".png", ".gif", ".mp4", ".html")
#: Simulated time between two frames of a video (ms).
FRAME_PERIOD_MS = 80
# Height of a caption's letters as share of the image's height, and their smallest height (pixels).
_CAPTION_SHARE, _MIN_CAPTION_HEIGHT = 1 / 22, 8


class FrameRecorder(EpisodeCallback):
    """Callback that records frames of an episode after chosen physics steps.

    Args:
        steps: Physics steps, ascending, after which a frame is recorded.
        draw: Function that returns a frame, a (height, width, 3) RGB image of the episode's
            current state.
        progress: Whether to show a progress bar on stderr.
        with_end: Whether to record the final state of the episode too.

    Attributes:
        frames: Recorded RGB images (height, width, 3), in order.
    """

    def __init__(
        self, steps: Sequence[int], draw: Callable[[Episode], Picture], progress: bool = False, with_end: bool = True
    ) -> None:
        self.frames: list[Picture] = []
        self._steps, self._draw, self._with_end = set(steps), draw, with_end
        self._progress = Progress(console=Console(stderr=True), disable=not progress, transient=False)
        self._bar = self._progress.add_task("drawing", total=max(len(self._steps), 1))

    def on_reset(self, episode: Episode) -> None:
        """Record the initial state of an episode, if step 0 was chosen."""
        self._progress.start()
        self.on_step(episode)

    def on_step(self, episode: Episode) -> None:
        """Record a frame, if the current step was chosen."""
        if episode.steps in self._steps:
            self.frames.append(self._draw(episode))
            self._progress.advance(self._bar)

    def on_end(self, episode: Episode) -> None:
        """Record the final state if requested, and close the progress bar."""
        if self._with_end and episode.steps not in self._steps:
            self.frames.append(self._draw(episode))
        self._progress.update(self._bar, completed=max(len(self._steps), 1))
        self._progress.stop()


def check_output_path(out: str | os.PathLike[str], suffixes: Sequence[str]) -> Path:
    """Return the path of an output file, after creating its folder and checking that it is writable.

    Args:
        out: Path of the file; `~` is expanded.
        suffixes: Allowed suffixes, such as ".png".

    Raises:
        OptionError: The suffix is not allowed, or needs a library that is not installed.
        ResultsError: The folder cannot be created or written to.
    """
    path = check_path("out", out)
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise OptionError(f"out must end in {', '.join(suffixes)}, got {str(path)!r}")
    if suffix == ".mp4":
        require_modules("an .mp4 file", "render", "imageio", "imageio_ffmpeg")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Permissions alone do not suffice: some file systems are read-only for everybody. The name of the temporary
        # file is as long as that which the file is written under.
        with tempfile.NamedTemporaryFile(prefix=f".{path.name}.", suffix=".part", dir=path.parent):
            is_folder = path.is_dir()
    except (OSError, ValueError) as error:
        raise ResultsError(f"cannot write {path} ({error}); choose another folder or name") from error
    if is_folder:
        raise ResultsError(f"cannot write {path}, which is a folder; choose another name")
    return path


def format_caption(episode: Episode) -> str:
    """Return time (s) and state of an episode as text, such as "3.20 s, released"; `render_scene` lists all."""
    time = f"{episode.steps * TIME_STEP:.2f} s"
    if episode.status is EpisodeStatus.SUCCESS:
        return f"{time}, goal reached"
    if episode.status:
        return f"{time}, {episode.status.label}"
    if episode.release_step is not None:
        return f"{time}, released"
    return f"{time}, object touched" if episode.contacts.robot_touches_object else time


def draw_caption(frame: Picture, text: str) -> Picture:
    """Return a copy of an RGB image with a caption in its lower left corner."""
    image = Image.fromarray(frame)
    size = max(frame.shape[0] * _CAPTION_SHARE, _MIN_CAPTION_HEIGHT)
    draw, place = ImageDraw.Draw(image), (0.6 * size, frame.shape[0] - 0.6 * size)
    font = ImageFont.load_default(size)
    left, top, right, bottom = draw.textbbox(place, text, font, anchor="lb")
    edge = 0.25 * size
    draw.rectangle((left - edge, top - edge, right + edge, bottom + edge), fill=(255, 255, 255))
    draw.text(place, text, (0, 0, 0), font, anchor="lb")
    return np.asarray(image)


def encode_grid(frames: list[Picture], columns: int) -> bytes:
    """Return a PNG image with a grid of RGB frames, `columns` in each row; empty cells are white."""
    rows = [frames[start : start + columns] for start in range(0, len(frames), columns)]
    blank = np.full_like(frames[0], 255)
    width = min(columns, len(frames))
    full = [np.concatenate([*row, *[blank] * (width - len(row))], axis=1) for row in rows]
    stream = io.BytesIO()
    Image.fromarray(np.concatenate(full)).save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def encode_video(frames: list[Picture], suffix: str) -> bytes:
    """Encode frames, `FRAME_PERIOD_MS` apart, as a video; return the content of a file with `suffix` .gif or .mp4."""
    if suffix == ".gif":
        stream = io.BytesIO()
        first, *rest = [Image.fromarray(frame).quantize(64) for frame in frames]
        first.save(
            stream, format="GIF", save_all=True, append_images=rest, duration=FRAME_PERIOD_MS, loop=0, optimize=True
        )
        return stream.getvalue()
    # Imported only here, because it is an optional dependency.
    import imageio.v3 as imageio

    frame_rate = 1000 / FRAME_PERIOD_MS
    return bytes(imageio.imwrite("<bytes>", np.stack(frames), extension=".mp4", fps=frame_rate, codec="libx264"))
