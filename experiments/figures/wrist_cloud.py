"""Draw images and point cloud of the wrist camera. The script needs the extras `plot` and `vision`.

    python experiments/figures/wrist_cloud.py --out docs/wrist.png

The robot waits at its start pose while the giver brings the object. `capture_wrist_camera()`
returns the current camera frame: depth image, segmentation mask, colors, and the points of object
and hand in the gripper's frame.
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

import handover_marl
from handover_marl.execution.files import write_atomically
from handover_marl.geometry.panda import GRIPPER_OUTLINE
from handover_marl.learning.training.scene_arguments import DatasetArgs

COLORS = ListedColormap(["#e8e8e8", "#555555", "#b08d57", "#e4572e", "#76b041", "#2e86ab"])


@dataclass(frozen=True)
class Args(DatasetArgs):
    """Options of the figure of the wrist camera.

    Attributes:
        scene: Scene number in s0 test.
        time: Time of the camera frame in the episode (s).
        out: PNG file to write.
    """

    scene: int = 209
    time: float = 2.5
    dataset: str = "synthetic"
    out: str = "wrist.png"


def capture_frame(args: Args) -> handover_marl.CameraCapture:
    """Return the wrist camera's frame at the time and in the scene that the options choose."""
    env = handover_marl.parallel_env(
        split="test",
        dataset=args.dataset,
        data_dir=args.data_dir,
        robot="panda_camera",
        physics="fast",
        camera_model="pinhole",
    )
    env.reset(options={"scene_id": args.scene})
    start = np.array(env.config.world_config.physics.panda.start_joints, dtype=np.float32)
    for _ in range(round(args.time / env.config.control_period)):
        env.step({"giver": np.zeros(8, dtype=np.float32), "receiver": start})
    view: handover_marl.CameraCapture = env.capture_wrist_camera()
    env.close()
    return view


def draw(view: handover_marl.CameraCapture) -> Figure:
    """Return a figure of color image, depth image, segmentation mask and point cloud."""
    figure = Figure(figsize=(13.0, 4.2), dpi=110, layout="constrained")
    grid = figure.add_gridspec(1, 4, width_ratios=[1.0, 1.0, 1.0, 1.5])
    pictures: list[tuple[str, Any, dict[str, Any]]] = [
        ("colours", view.rgb, {}),
        ("depth", view.depth, {"cmap": "viridis_r"}),
        ("segmentation", view.segmentation, {"cmap": COLORS, "vmin": -0.5, "vmax": 5.5, "interpolation": "nearest"}),
    ]
    for column, (title, picture, options) in enumerate(pictures):
        axes = figure.add_subplot(grid[column])
        axes.imshow(picture, **options)
        axes.set_title(title)
        axes.set_axis_off()
    cloud: Any = figure.add_subplot(grid[3], projection="3d")
    for seen, points in (
        (handover_marl.SegmentationLabel.TARGET, view.object_points),
        (handover_marl.SegmentationLabel.HAND, view.hand_points),
    ):
        cloud.scatter(points[:, 1], points[:, 2], points[:, 0], s=2.0, color=COLORS(int(seen)), label=seen.name.lower())
    fork = np.array(GRIPPER_OUTLINE)
    cloud.plot(
        fork[:, 1], fork[:, 2], fork[:, 0], color=COLORS(int(handover_marl.SegmentationLabel.ROBOT)), label="gripper"
    )
    cloud.set_xlabel("y (m)")
    cloud.set_ylabel("z, ahead (m)")
    cloud.set_zlabel("x (m)")
    cloud.set_aspect("equal")
    cloud.set_box_aspect(None, zoom=0.8)
    cloud.locator_params(nbins=4)
    cloud.view_init(elev=25.0, azim=-60.0)
    cloud.set_title("cloud in the gripper's frame")
    cloud.legend(loc="upper left", fontsize=8)
    return figure


def main(args: Args) -> None:
    """Capture a frame of the wrist camera and write the figure."""
    stream = io.BytesIO()
    draw(capture_frame(args)).savefig(stream, format="png")
    write_atomically(Path(args.out), stream.getvalue())


if __name__ == "__main__":
    main(tyro.cli(Args))
