"""Pictures: frames of an episode as image grids and videos, the wrist camera's view, paths and heat maps.

Figures need matplotlib (extra `plot`), videos as `.mp4` need imageio (extra `render`).
"""

import io
import os
import tempfile
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageColor, ImageDraw, ImageFont
from rich.console import Console
from rich.progress import Progress

from handover_marl.config import OFFICIAL_CONFIG, TABLE_HEIGHT, TIME_STEP, CameraConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import EpisodeCallback
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, ResultsError
from handover_marl.execution.options import check_path, require_modules
from handover_marl.geometry.poses import transform_points
from handover_marl.simulation.camera.images import LABEL_COLORS, SegmentationLabel
from handover_marl.simulation.camera.optics import WRIST_CAMERA

Picture = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float64]

#: Suffixes of all kinds of output files.
SUFFIXES = (".png", ".gif", ".mp4", ".html")
#: Simulated time between two frames of a video (ms).
FRAME_PERIOD_MS = 80
# Height of a caption's letters as share of the image's height, and their smallest height (pixels).
_CAPTION_SHARE, _MIN_CAPTION_HEIGHT = 1 / 22, 8
_DPI = 100
# Success rate above which a cell is so dark that its text is white.
_WHITE_TEXT_THRESHOLD = 0.55
# Longest line, and most lines, of the name of a policy with many options.
_MAX_LINE, _MAX_LINES = 30, 3
_PALETTE = np.array([ImageColor.getrgb(LABEL_COLORS[label]) for label in SegmentationLabel], dtype=np.uint8)


class FrameRecorder(EpisodeCallback):
    """Callback that records RGB images (frames) of an episode after chosen physics steps, and at the end.

    Args:
        steps: Physics steps, ascending, after which a frame is recorded.
        draw: Function that returns a frame of the episode's current state.
        progress: Whether to show a progress bar on stderr.

    Attributes:
        frames: Recorded RGB images (height, width, 3), in order.
    """

    def __init__(self, steps: Sequence[int], draw: Callable[[Episode], Picture], progress: bool = False) -> None:
        self.frames: list[Picture] = []
        self._steps, self._draw = set(steps), draw
        self._progress = Progress(console=Console(stderr=True), disable=not progress, transient=False)
        self._bar = self._progress.add_task("drawing", total=max(len(self._steps), 1))

    def on_reset(self, episode: Episode) -> None:
        """Show the progress bar, and record the initial state if step 0 was chosen."""
        self._progress.start()
        self.on_step(episode)

    def on_step(self, episode: Episode) -> None:
        """Record a frame, if the current step was chosen."""
        if episode.steps in self._steps:
            self.frames.append(self._draw(episode))
            self._progress.advance(self._bar)

    def on_end(self, episode: Episode) -> None:
        """Record the final state unless its step was chosen, and close the progress bar."""
        if episode.steps not in self._steps:
            self.frames.append(self._draw(episode))
        self._progress.update(self._bar, completed=max(len(self._steps), 1))
        self._progress.stop()


def prepare_output_path(out: str | os.PathLike[str], suffixes: Sequence[str]) -> Path:
    """Check an output file and create its folder; return the path of the file.

    Another suffix or a missing package raises `OptionError`, a file that cannot be written `ResultsError`.
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
    """Return time (s) and state of an episode as text, e.g. "3.20 s, released"; `render_scene` lists the states."""
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
    """Return the content of a video file with the `suffix` .gif or .mp4; RGB frames are `FRAME_PERIOD_MS` apart."""
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


def draw_wrist_view(episode: Episode, camera: CameraConfig) -> Picture:
    """Return an RGB image (h, w, 3) uint8: an outside view above colors, depth and segmentation of the wrist camera.

    The depth is brighter the nearer it is, and black from 2 m on. `camera` is the outside camera.
    """
    frame = episode.capture_wrist_camera()
    depth = np.clip(255.0 * (1.0 - frame.depth / WRIST_CAMERA.far), 0.0, 255.0).astype(np.uint8)
    images = (frame.rgb, np.stack([depth] * 3, axis=-1), _PALETTE[frame.segmentation])
    width = camera.width // len(images)
    height = max(1, round(width * depth.shape[0] / depth.shape[1]))
    strip = np.full((height, camera.width, 3), 255, dtype=np.uint8)
    for number, image in enumerate(images):
        resized = Image.fromarray(image).resize((width, height), Image.Resampling.NEAREST)
        strip[:, number * width : (number + 1) * width] = np.asarray(resized)
    picture: Picture = np.concatenate([episode.render(camera), strip])
    # H.264 videos need an even number of pixels a side.
    return picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]


def draw_recording(bodies: Mapping[str, Array]) -> bytes:
    """Draw recorded poses (n, 7) of bodies, by name, from above and from the side; return a PNG.

    Positions are in the world frame (m), quaternions xyzw. A dot is at the start; the axes x (red), y (green) and z
    (blue) of the body's frame are at the end.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 5.0), dpi=_DPI, layout="constrained")
    base = OFFICIAL_CONFIG.physics.panda.base_position
    for number, (across, up) in enumerate(((0, 1), (1, 2)), start=1):
        axes = figure.add_subplot(1, 2, number)
        axes.plot(base[across], base[up], "ks", label="robot's base")
        if up == 2:
            axes.axhline(TABLE_HEIGHT, color="gray", label="table")
        for name, poses in bodies.items():
            (line,) = axes.plot(poses[:, across], poses[:, up], label=name)
            axes.plot(poses[0, across], poses[0, up], "o", color=line.get_color())
            for tip, color in zip(transform_points(poses[-1], 0.05 * np.eye(3)), "rgb", strict=True):
                ends = np.stack([poses[-1, :3], tip])
                axes.plot(ends[:, across], ends[:, up], color=color, linewidth=1)
        axes.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)")
        axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize="small")
    return _save(figure)


def draw_heat_map(
    rates: Sequence[Sequence[float]],
    rows: Sequence[str],
    columns: Sequence[str],
    title: str,
    axis_labels: tuple[str, str] = ("giver", "receiver"),
) -> bytes:
    """Draw success rates (0 to 1), one list for each row, as a heat map; return a PNG.

    Names of `rows` and `columns` are wrapped and cut off if they are long. `axis_labels` are the titles of the vertical
    axis (rows) and of the horizontal axis (columns).
    """
    from matplotlib.figure import Figure

    rows, columns = ([_wrap_name(name) for name in names] for names in (rows, columns))
    figure = Figure(figsize=(2.6 + 1.3 * len(columns), 1.9 + 0.55 * len(rows)), dpi=150, layout="tight")
    axes = figure.add_subplot()
    image = axes.imshow(rates, cmap="viridis_r", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(columns)), columns, rotation=30, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(rows)), rows)
    axes.set(xlabel=axis_labels[1], ylabel=axis_labels[0])
    figure.suptitle(title, fontsize=8, wrap=True)
    for (row, column), rate in np.ndenumerate(rates):
        color = "white" if rate > _WHITE_TEXT_THRESHOLD else "black"
        axes.text(column, row, f"{100 * rate:.0f} %", ha="center", va="center", color=color)
    figure.colorbar(image, ax=axes, label="success")
    return _save(figure)


def _save(figure: Any) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _wrap_name(name: str) -> str:
    """Return a name with line breaks between options, cut off after `_MAX_LINES` lines."""
    spaced = name.replace(",", ", ").replace(":", ": ")
    return "\n".join(textwrap.wrap(spaced, _MAX_LINE, max_lines=_MAX_LINES, placeholder=" ..."))
