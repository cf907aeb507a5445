"""Render a gallery of synthetic scenes: every object at its handover pose.

python experiments/figures/render_gallery.py --out docs/gallery.png
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from PIL import Image
from rich.console import Console
from rich.progress import track

from handover_marl.cli.options import SceneNumbers
from handover_marl.config import CameraConfig, PandaConfig
from handover_marl.datasets import Dataset
from handover_marl.episode.episode import Episode
from handover_marl.learning.training.scene_arguments import DatasetArgs

Picture = npt.NDArray[np.uint8]
# One scene per object, with varied hands and subjects.
_SCENES = tuple(100 * (n % 10) + 5 * n + (n * 7) % 5 for n in range(20))


@dataclass(frozen=True, kw_only=True)
class Args(DatasetArgs):
    """Options of the gallery of scenes.

    Attributes:
        out: Image file to write.
        scenes: Scene numbers; default: one scene per object, with varied hands and subjects.
        columns: Number of images in a row.
        size: Width of one image (pixels).
    """

    out: Path
    scenes: SceneNumbers = _SCENES
    columns: int = 5
    size: int = 240
    dataset: str = "synthetic"


def main(args: Args) -> None:
    dataset = args.open_dataset()
    episode = Episode()
    pictures = [
        render_handover_pose(episode, dataset, scene, args.size)
        for scene in track(args.scenes or _SCENES, console=Console(stderr=True))
    ]
    episode.close()
    rows = [
        np.concatenate(pictures[start : start + args.columns], axis=1)
        for start in range(0, len(pictures), args.columns)
    ]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).quantize(128).save(args.out, optimize=True)


def render_handover_pose(episode: Episode, dataset: Dataset, scene_id: int, size: int) -> Picture:
    """Return an image of the handed-over object at its final pose, seen from the robot's side.

    Args:
        episode: Simulator; the scene is loaded into it.
        dataset: Dataset of the scene.
        scene_id: Scene number.
        size: Width of the image (pixels).
    """
    episode.reset(dataset.load_scene(scene_id))
    start = np.array(PandaConfig().start_joints, dtype=np.float32)
    episode.advance(start, episode.scene.n_frames)
    x, y, z = (float(value) for value in episode.observe()["object_poses"][0, :3])
    camera = CameraConfig(
        width=size,
        height=size * 3 // 4,
        vertical_fov=40.0,
        position=(x + 0.42, y - 0.42, z + 0.28),
        target=(x, y + 0.05, z - 0.02),
    )
    return episode.render(camera)


if __name__ == "__main__":
    main(tyro.cli(Args))
