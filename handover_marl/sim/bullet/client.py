"""Connections to PyBullet and the loading of model files."""

import contextlib
import ctypes
import functools
import inspect
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.config import CameraConfig
from handover_marl.errors import DataFormatError, SimulationError
from handover_marl.models.obj_files import check_obj
from handover_marl.models.urdf_shapes import named_meshes
from handover_marl.options import check_pybullet
from handover_marl.sim.bullet.drawing import aim_window


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Send what C code writes to stderr nowhere: PyBullet greets with its build time."""
    # A program without a console has no sys.stderr, one that closed it has none that can be flushed.
    with contextlib.suppress(AttributeError, OSError, ValueError):
        sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:
        # Closed: silent as it is.
        yield
        return
    try:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


# A last line: who can do without asks before this room is entered.
check_pybullet("this", "take physics='mujoco'")
with _silenced():
    import pybullet

#: What PyBullet raises when it refuses something.
pybullet_error: type[Exception] = pybullet.error


class BulletClient:
    """PyBullet's functions and constants, bound to a physics server of its own.

    Disconnects when it is collected. It must not be copied: two holders would close one server twice.
    """

    _server = -1

    def __init__(self, mode: int) -> None:
        try:
            self._server = pybullet.connect(mode)
        except pybullet.error as error:
            if mode != pybullet.GUI:
                raise SimulationError(f"PyBullet did not start a physics server ({error})") from error
            raise SimulationError(
                'PyBullet shows one window in a process: close the other environment with render_mode="human" first'
            ) from error
        if self._server < 0:
            raise SimulationError("PyBullet did not start a physics server")

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(pybullet, name)
        if inspect.isbuiltin(attribute):
            attribute = functools.partial(attribute, physicsClientId=self._server)
        # Kept on the instance, so that each name is looked up once.
        setattr(self, name, attribute)
        return attribute

    def close(self) -> None:
        """Disconnect; safe to call twice, and after the window or the server has gone."""
        server, self._server = self._server, -1
        if server >= 0:
            with contextlib.suppress(pybullet.error):
                pybullet.disconnect(physicsClientId=server)

    def __del__(self) -> None:
        self.close()


def connect(window: bool = False, camera: CameraConfig | None = None) -> BulletClient:
    """A physics server of its own in this process, with PyBullet's window if asked for.

    Args:
        window: Whether to open PyBullet's window, without its side panels.
        camera: Where the window looks from at first; the default camera if not given.

    Raises:
        SimulationError: A window was asked for where there is no screen, or beside another window.
    """
    if not window:
        return BulletClient(pybullet.DIRECT)
    if sys.platform.startswith("linux"):
        _require_screen()
    client = BulletClient(pybullet.GUI)
    client.configureDebugVisualizer(client.COV_ENABLE_GUI, 0)
    aim_window(client, camera or CameraConfig())
    return client


def _require_screen() -> None:
    """Check that an X server answers and can draw; without that PyBullet ends the whole process.

    Raises:
        SimulationError: None does.
    """
    fault = _screen_fault()
    if fault:
        raise SimulationError(
            f'render_mode="human" opens a window and needs a screen, but {fault}. '
            'Use render_mode="rgb_array", or start the program under xvfb-run.'
        )


def _screen_fault() -> str:
    """What keeps PyBullet from opening a window on an X server; empty if nothing does."""
    name = os.environ.get("DISPLAY")
    if not name:
        return "DISPLAY is not set"
    try:
        # The file PyBullet opens itself.
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return "libX11, the X11 client library, is not installed"
    x11.XOpenDisplay.argtypes, x11.XOpenDisplay.restype = (ctypes.c_char_p,), ctypes.c_void_p
    x11.XQueryExtension.argtypes = (ctypes.c_void_p, ctypes.c_char_p, *[ctypes.POINTER(ctypes.c_int)] * 3)
    x11.XCloseDisplay.argtypes = (ctypes.c_void_p,)
    display = x11.XOpenDisplay(os.fsencode(name))
    if not display:
        return f"no X server answers at DISPLAY={name}"
    codes = [ctypes.c_int() for _ in range(3)]
    draws = x11.XQueryExtension(display, b"GLX", *map(ctypes.byref, codes))
    x11.XCloseDisplay(display)
    return "" if draws else f"the X server at DISPLAY={name} has no OpenGL (GLX)"


def load_urdf(client: BulletClient, path: Path | str, **options: object) -> int:
    """Load a model file and return its body id.

    Raises:
        SimulationError: PyBullet cannot load it.
    """
    _check_meshes(Path(path))
    try:
        return int(client.loadURDF(str(path), **options))
    except pybullet.error as error:
        raise SimulationError(
            f"{path}: PyBullet cannot load this model ({error}); check the file and its meshes"
        ) from error


def _check_meshes(urdf: Path) -> None:
    """Refuse meshes that would end the process: PyBullet trusts the numbers in them."""
    try:
        _check_meshes_of(urdf, urdf.stat().st_mtime_ns)
    except (OSError, ValueError) as error:
        if isinstance(error, DataFormatError):
            raise SimulationError(f"{urdf}: {error}") from error
        # PyBullet looks for it in its own data folder, too.


@functools.lru_cache(maxsize=256)
def _check_meshes_of(urdf: Path, changed: int) -> None:
    for _, mesh in named_meshes(urdf):
        if mesh.suffix.lower() == ".obj" and mesh.exists():
            check_obj(mesh)


def float32_list(values: Sequence[float]) -> list[float]:
    """Values rounded to float32, as plain floats.

    The reference hands every target, gain and pose over as float32, so Bullet must see those bits.
    """
    rounded: list[float] = np.asarray(values, dtype=np.float32).tolist()
    return rounded
