"""Figure of an episode beside the wrist camera's images; needs matplotlib (extra `plot`)."""

from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import CameraConfig
from handover_marl.episode.camera_observations import CameraCapture
from handover_marl.episode.episode import Episode
from handover_marl.execution.options import require_modules
from handover_marl.geometry.panda import GRIPPER_OUTLINE
from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.simulation.camera.optics import EMPTY_DEPTH, FAR
from handover_marl.visualization.colors import LABEL_COLORS
from handover_marl.visualization.video import format_caption

Picture = npt.NDArray[np.uint8]

_DPI = 100
# Range of the point cloud's panel ahead of the hand and to its sides (m).
_FORWARD_EXTENT, _LATERAL_EXTENT = 0.8, 0.35


def require_matplotlib(feature: str) -> None:
    """Check that matplotlib is installed.

    Args:
        feature: Feature that needs matplotlib, for the message.

    Raises:
        OptionError: matplotlib is not installed.
    """
    require_modules(feature, "plot", "matplotlib")


class WristCameraFigure:
    """Figure of an outside view beside depth, segmentation and point cloud of the wrist camera.

    Args:
        camera: Outside camera, whose image fills the left half of the figure; the panels of the
            wrist camera fill the right half.

    Raises:
        OptionError: matplotlib is not installed.
    """

    def __init__(self, camera: CameraConfig) -> None:
        require_matplotlib("view='wrist'")
        # Imported only here, because it is an optional dependency.
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._camera = camera
        # Two columns of equal width, and space for titles.
        figure = Figure(figsize=(2.0 * camera.width / _DPI, camera.height / _DPI + 0.4), dpi=_DPI, layout="constrained")
        self._canvas = FigureCanvasAgg(figure)
        grid = figure.add_gridspec(2, 4)
        self._outside_axes = figure.add_subplot(grid[:, :2])
        self._depth_axes = figure.add_subplot(grid[0, 2])
        self._segmentation_axes = figure.add_subplot(grid[1, 2])
        self._cloud_axes = figure.add_subplot(grid[:, 3])

    def draw(self, episode: Episode) -> Picture:
        """Draw the episode's current state; return an RGB image (height, width, 3)."""
        from matplotlib.colors import ListedColormap

        frame = episode.capture_wrist_camera()
        outside_title = f"scene {episode.scene.info.scene_id}, {format_caption(episode)}"
        _draw_image(self._outside_axes, episode.render(self._camera), outside_title)
        depth = np.ma.masked_greater_equal(frame.depth, EMPTY_DEPTH)
        _draw_image(self._depth_axes, depth, f"depth, 0 to {FAR:g} m", cmap="viridis_r", vmin=0.0, vmax=FAR)
        colors = ListedColormap([LABEL_COLORS[label] for label in SegmentationLabel])
        span = {"vmin": -0.5, "vmax": len(SegmentationLabel) - 0.5}
        _draw_image(
            self._segmentation_axes, frame.segmentation, "segmentation", cmap=colors, interpolation="nearest", **span
        )
        self._draw_cloud(frame)
        self._canvas.draw()  # type: ignore[no-untyped-call]
        picture: Picture = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]
        # H.264 videos need an even number of pixels a side.
        return picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]

    def _draw_cloud(self, frame: CameraCapture) -> None:
        axes = self._cloud_axes
        axes.clear()
        for label, points in (
            (SegmentationLabel.TARGET, frame.object_points),
            (SegmentationLabel.HAND, frame.hand_points),
        ):
            name = "object" if label is SegmentationLabel.TARGET else "hand"
            axes.scatter(points[:, 1], points[:, 2], s=1.0, color=LABEL_COLORS[label], label=f"{name}: {len(points)}")
        outline = np.array(GRIPPER_OUTLINE)
        axes.plot(outline[:, 1], outline[:, 2], color=LABEL_COLORS[SegmentationLabel.ROBOT])
        axes.set_xlim(-_LATERAL_EXTENT, _LATERAL_EXTENT)
        axes.set_ylim(-0.02, _FORWARD_EXTENT)
        axes.set_aspect("equal")
        axes.set_xlabel("y of the gripper (m)", fontsize=8)
        axes.set_ylabel("ahead of the gripper (m)", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.legend(loc="upper right", fontsize=8, markerscale=5.0)
        axes.set_title("cloud from above the gripper", fontsize=9)


def _draw_image(axes: Any, image: npt.NDArray[Any], title: str, **options: Any) -> None:
    axes.clear()
    axes.imshow(image, **options)
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()
