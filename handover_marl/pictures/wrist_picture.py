"""What the robot sees beside what it does: depth, segmentation and cloud of the wrist camera. Needs matplotlib."""

import importlib.util

import numpy as np
import numpy.typing as npt

from handover_marl.config import CameraConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.sight import View
from handover_marl.errors import OptionError
from handover_marl.models.panda import GRIPPER_OUTLINE
from handover_marl.pictures.seen_colors import SEEN_COLORS
from handover_marl.sim.camera.optics import FAR, NOTHING
from handover_marl.sim.camera.photo import Seen

Picture = npt.NDArray[np.uint8]

_DPI = 100
# How far the cloud's panel reaches ahead of the hand and to its sides (m).
_AHEAD, _ASIDE = 0.8, 0.35


def check_plot() -> None:
    """Check that matplotlib is there.

    Raises:
        OptionError: It is not.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise OptionError("the wrist camera's picture needs matplotlib: pip install 'handover-marl[plot]'")


class WristPicture:
    """Draws an episode's present moment: from outside, and depth, segmentation and cloud of the wrist camera.

    Args:
        camera: Where to look from outside; its size is that of the picture from outside, to whose right the camera's
            three take as much room again.

    Raises:
        OptionError: matplotlib is not installed.
    """

    def __init__(self, camera: CameraConfig) -> None:
        check_plot()
        # Only now, since it needs an extra.
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._camera = camera
        # Two columns of equal width, and room for titles.
        figure = Figure(figsize=(2.0 * camera.width / _DPI, camera.height / _DPI + 0.4), dpi=_DPI, layout="constrained")
        self._canvas = FigureCanvasAgg(figure)
        grid = figure.add_gridspec(2, 4)
        self._outside = figure.add_subplot(grid[:, :2])
        self._depth = figure.add_subplot(grid[0, 2])
        self._seen = figure.add_subplot(grid[1, 2])
        self._cloud = figure.add_subplot(grid[:, 3])

    def __call__(self, episode: Episode) -> Picture:
        """(height, width, 3) RGB."""
        view = episode.look()
        self._draw_outside(episode)
        self._draw_depth(view)
        self._draw_segmentation(view)
        self._draw_cloud(view)
        self._canvas.draw()  # type: ignore[no-untyped-call]
        picture: Picture = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]
        # Films in the usual encoding have an even number of pixels a side.
        return picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]

    def _draw_outside(self, episode: Episode) -> None:
        axes = self._outside
        axes.clear()
        axes.imshow(episode.render(self._camera))
        axes.set_title(f"scene {episode.scene.info.scene_id}, {episode.steps / 1000.0:.2f} s", fontsize=9)
        axes.set_axis_off()

    def _draw_depth(self, view: View) -> None:
        axes = self._depth
        axes.clear()
        shown = np.ma.masked_greater_equal(view.depth, NOTHING)
        axes.imshow(shown, cmap="viridis_r", vmin=0.0, vmax=FAR)
        axes.set_title(f"depth, 0 to {FAR:g} m", fontsize=9)
        axes.set_axis_off()

    def _draw_segmentation(self, view: View) -> None:
        from matplotlib.colors import ListedColormap

        axes = self._seen
        axes.clear()
        colors = ListedColormap([SEEN_COLORS[seen] for seen in Seen])
        axes.imshow(view.segmentation, cmap=colors, vmin=-0.5, vmax=len(Seen) - 0.5, interpolation="nearest")
        axes.set_title("segmentation", fontsize=9)
        axes.set_axis_off()

    def _draw_cloud(self, view: View) -> None:
        axes = self._cloud
        axes.clear()
        for seen, points in ((Seen.TARGET, view.object_points), (Seen.HAND, view.hand_points)):
            name = "object" if seen is Seen.TARGET else "hand"
            axes.scatter(points[:, 1], points[:, 2], s=1.0, color=SEEN_COLORS[seen], label=f"{name}: {len(points)}")
        outline = np.array(GRIPPER_OUTLINE)
        axes.plot(outline[:, 1], outline[:, 2], color=SEEN_COLORS[Seen.ROBOT])
        axes.set_xlim(-_ASIDE, _ASIDE)
        axes.set_ylim(-0.02, _AHEAD)
        axes.set_aspect("equal")
        axes.set_xlabel("y of the gripper (m)", fontsize=8)
        axes.set_ylabel("ahead of the gripper (m)", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.legend(loc="upper right", fontsize=8, markerscale=5.0)
        axes.set_title("cloud from above the gripper", fontsize=9)
