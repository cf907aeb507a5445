"""Render a grid of images for each family of givers: a row for each giver, a column for each time.

    python experiments/strangers/render_image_grids.py --out docs/reference/strangers_v1

All givers act with the same receiver in the same scene, seen from the same place. The first row replays the recording.
Its path of the wrist is orange in all other rows, the path of the giver is blue.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from PIL import Image, ImageDraw
from rich.console import Console
from rich.progress import track

from handover_marl.config import TIME_STEP, CameraConfig
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.episode import Episode
from handover_marl.evaluation.config import REPLAY
from handover_marl.evaluation.rendering import ScenePlayer
from handover_marl.execution.files import write_atomically
from handover_marl.learning.training.scene_arguments import DatasetArgs
from handover_marl.policies.populations import DEFAULT_POPULATION, load_population
from handover_marl.visualization.video import FrameRecorder, Picture, draw_caption, format_caption

Array = npt.NDArray[np.float64]

_GIVER_COLOR, _RECORDING_COLOR = (30, 90, 255), (255, 130, 0)
_PATH_PERIOD = 20  # physics steps between two points of a path


@dataclass(frozen=True, kw_only=True)
class Args(DatasetArgs):
    """Options of the image grids.

    Attributes:
        out: Folder of the images FAMILY.jpg.
        population: Name of a shipped population, or path of a file.
        families: Families to render; default: all.
        receiver: The robot's policy.
        scene: Scene number.
        times: Times of the columns (s).
        width: Width of one image (pixels).
        quality: Quality of the JPEG files, 1 to 95.
    """

    out: Path
    population: str = DEFAULT_POPULATION
    families: tuple[str, ...] = ()
    receiver: str = "reactive"
    scene: int = 95
    times: tuple[float, ...] = (1.4, 2.0, 2.5, 3.0, 3.6, 4.6)
    width: int = 210
    quality: int = 80
    dataset: str = "synthetic"


class PathRecorder(EpisodeCallback):
    """Callback that records the path of the wrist.

    Attributes:
        points: World positions of the wrist (m), one every 20 ms in which the hand is visible.
    """

    def __init__(self) -> None:
        self.points: list[npt.NDArray[np.float32]] = []

    def on_step(self, episode: Episode) -> None:
        """Record the position of the wrist."""
        if episode.steps % _PATH_PERIOD == 0:
            state = episode.observe()
            if state["hand_present"][0]:
                self.points.append(state["hand_keypoints"][0].copy())


def project_points(camera: CameraConfig, points: npt.ArrayLike) -> Array:
    """Return the pixels (n, 2) of world positions (n, 3), as x from the left and y from the top."""
    forward = np.subtract(camera.target, camera.position)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    offsets = np.asarray(points, dtype=np.float64).reshape(-1, 3) - camera.position
    focal_length = 0.5 * camera.height / np.tan(np.radians(camera.vertical_fov) / 2.0)
    scaled = focal_length / (offsets @ forward)
    x, y = offsets @ right * scaled, offsets @ np.cross(right, forward) * scaled
    return np.stack([0.5 * camera.width + x, 0.5 * camera.height - y], axis=1)


def format_frame_caption(episode: Episode) -> str:
    """Return simulated time, state and time of the release."""
    release = "" if episode.release_step is None else f" at {episode.release_step * TIME_STEP:.2f} s"
    caption = format_caption(episode)
    return caption + (release if caption.endswith("released") or not release else f", released{release}")


def draw_path(frame: Picture, pixels: Array, color: tuple[int, int, int], width: int) -> Picture:
    """Return a copy of an RGB image with a path of pixels (n, 2), of a width in pixels."""
    image = Image.fromarray(frame)
    if len(pixels) > 1:
        ImageDraw.Draw(image).line([tuple(pixel) for pixel in pixels.tolist()], fill=color, width=width)
    return np.asarray(image)


class GridRenderer:
    """Renderer of the rows of image grids.

    Args:
        args: Options of the script.
    """

    def __init__(self, args: Args) -> None:
        self._args = args
        self._camera = CameraConfig(
            width=args.width,
            height=args.width * 3 // 4,
            vertical_fov=42.0,
            position=(1.4, 0.9, 1.8),
            target=(0.5, 0.08, 1.25),
        )
        self._recorded: Array = np.zeros((0, 2))
        self.replay_row = self.render_row(REPLAY, REPLAY)

    def render_row(self, name: str, giver: str) -> Picture:
        """Return the images of an episode side by side; those after the end are white, but the first one.

        Args:
            name: Name of the giver, for the caption.
            giver: The person's policy.
        """
        path, args = PathRecorder(), self._args

        def draw(episode: Episode) -> Picture:
            frame = draw_path(episode.render(self._camera), self._recorded, _RECORDING_COLOR, 5)
            frame = draw_path(frame, project_points(self._camera, path.points), _GIVER_COLOR, 2)
            first = f"{name}, " if episode.steps == steps[0] else ""
            return draw_caption(frame, first + format_frame_caption(episode))

        steps = [round(time / TIME_STEP) for time in args.times]
        frames = FrameRecorder(steps, draw)
        options = {"dataset": args.dataset, "data_dir": args.data_dir, "physics": "fast", "trust": True}
        player = ScenePlayer(args.scene, args.receiver, giver, options)
        player.play(steps[-1], [path, frames])
        player.close()
        if name == REPLAY:
            self._recorded = project_points(self._camera, path.points)
        shown = [*frames.frames, *[np.full_like(frames.frames[0], 255)] * len(steps)][: len(steps)]
        return np.concatenate(shown, axis=1)


def encode_grid(rows: Sequence[Picture], quality: int) -> bytes:
    """Return a JPEG image with rows one above the other."""
    stream = io.BytesIO()
    Image.fromarray(np.concatenate(rows)).save(stream, format="JPEG", quality=quality, optimize=True)
    return stream.getvalue()


def main(args: Args) -> None:
    """Render the image grids of all chosen families."""
    population = load_population(args.population)
    families = args.families or tuple(dict.fromkeys(giver.family for giver in population.givers))
    renderer = GridRenderer(args)
    args.out.mkdir(parents=True, exist_ok=True)
    for family in track(families, console=Console(stderr=True)):
        givers = [giver for giver in population.givers if giver.family == family]
        rows = [renderer.render_row(giver.name, population.get_policy(giver)) for giver in givers]
        write_atomically(args.out / f"{family}.jpg", encode_grid([renderer.replay_row, *rows], args.quality))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
