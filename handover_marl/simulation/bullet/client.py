"""Connections to PyBullet physics servers, their window, and loading of model files."""

import contextlib
import ctypes
import functools
import inspect
import locale
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.config import CameraConfig
from handover_marl.errors import SimulationError
from handover_marl.execution.options import require_pybullet
from handover_marl.execution.reading import cached_by_file
from handover_marl.geometry.model_files.obj_files import check_mesh
from handover_marl.geometry.model_files.urdf import list_mesh_references
from handover_marl.geometry.model_files.urdf_xml import parse_urdf


@contextlib.contextmanager
def _silence_stderr() -> Iterator[None]:
    """Discard the output of C code on stderr, where PyBullet prints its build time at import."""
    try:
        original = os.dup(2)
    except OSError:
        # A closed stderr needs no redirection.
        yield
        return
    try:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(original, 2)
        os.close(original)


# Callers check this before they import the module; here it gives a helpful error instead of an ImportError.
require_pybullet("this", "take physics='mujoco'")
with _silence_stderr():
    import pybullet

#: Fields of a PyBullet contact point.
CONTACT_BODY_B, CONTACT_LINK_A, CONTACT_POSITION_ON_A, CONTACT_NORMAL_FORCE = 2, 3, 5, 9

# Functions of PyBullet that read model files.
_FILE_READERS = ("createCollisionShape", "createVisualShape", "loadURDF")
_locale_lock = threading.Lock()

#: Class of all errors that PyBullet raises.
pybullet_error: type[Exception] = pybullet.error


@contextlib.contextmanager
def _use_decimal_point() -> Iterator[None]:
    """Use the decimal point of the locale "C" while this context is active.

    PyBullet reads the numbers in model files by the program's locale: with a decimal comma, 0.5 would be 0. A locale
    belongs to the whole process, hence the lock; other threads of the program see the locale "C" meanwhile.
    """
    with _locale_lock:
        before = locale.setlocale(locale.LC_NUMERIC)
        locale.setlocale(locale.LC_NUMERIC, "C")
        try:
            yield
        finally:
            locale.setlocale(locale.LC_NUMERIC, before)


class BulletClient:
    """PyBullet's functions and constants, bound to one physics server.

    `mode` is PyBullet's DIRECT, or GUI for a window. If the server does not start, a SimulationError says why. The
    client disconnects when it is garbage collected. It must not be copied: both copies would close the server.
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
        if name in _FILE_READERS:
            attribute = _use_decimal_point()(attribute)
        # Stored on the instance: each name is looked up once.
        setattr(self, name, attribute)
        return attribute

    def close(self) -> None:
        """Disconnect from the physics server, unless it is already disconnected."""
        server, self._server = self._server, -1
        if server >= 0:
            with contextlib.suppress(pybullet.error):
                pybullet.disconnect(physicsClientId=server)

    def __del__(self) -> None:
        self.close()


def connect(window: bool = False) -> BulletClient:
    """Start a physics server in this process, with PyBullet's window if `window` is True, and return its client."""
    if not window:
        return BulletClient(pybullet.DIRECT)
    if sys.platform.startswith("linux"):
        _require_screen()
    client = BulletClient(pybullet.GUI)
    client.configureDebugVisualizer(client.COV_ENABLE_GUI, 0)
    # The view of the default overview camera.
    view = {"cameraDistance": 1.6155494421403513, "cameraYaw": 90.0, "cameraPitch": -21.801409486351815}
    client.resetDebugVisualizerCamera(**view, cameraTargetPosition=CameraConfig().target)
    return client


def _require_screen() -> None:
    """Raise `SimulationError` if there is no X server, without which PyBullet would end the whole process."""
    fault = f"no X server answers at DISPLAY={os.environ.get('DISPLAY')}"
    try:
        # The same file that PyBullet opens.
        x11 = ctypes.CDLL("libX11.so.6")
        x11.XOpenDisplay.restype, x11.XCloseDisplay.argtypes = ctypes.c_void_p, (ctypes.c_void_p,)
        display = x11.XOpenDisplay(None)
    except OSError:
        display, fault = None, "libX11, the X11 client library, is not installed"
    if not display:
        raise SimulationError(
            f'render_mode="human" opens a window and needs a screen, but {fault}. '
            'Use render_mode="rgb_array", or start the program under xvfb-run.'
        )
    x11.XCloseDisplay(display)


def load_urdf(client: BulletClient, path: Path | str, **options: object) -> int:
    """Load a URDF file by PyBullet's `loadURDF` and return the body number; raise `SimulationError` if this fails."""
    urdf = Path(path)
    # A missing file may still be in PyBullet's own data folder.
    with contextlib.suppress(OSError):
        check_model_files(urdf)
    try:
        return int(client.loadURDF(str(path), **options))
    except pybullet.error as error:
        raise SimulationError(
            f"{path}: PyBullet cannot load this model ({error}); check the file and its meshes"
        ) from error


@cached_by_file(maxsize=256)
def check_model_files(urdf: Path) -> None:
    """Raise `SimulationError` if a URDF file or its meshes are not safe to load in PyBullet.

    PyBullet crashes on invalid vertex numbers, waits forever if a path is a pipe, and accepts numbers of any size. The
    check is repeated only when the URDF file changes. A missing URDF file raises `OSError`.
    """
    try:
        parse_urdf(urdf)
        for _, mesh in list_mesh_references(urdf):
            if mesh.exists():
                check_mesh(mesh)
    except ValueError as error:
        raise SimulationError(f"{urdf}: PyBullet cannot load this model ({error}); check the file") from error


def to_float32_list(values: Sequence[float]) -> list[float]:
    """Round values to float32 and return them as Python floats.

    HandoverSim passes all targets, gains and poses as float32, so equal results need the same bits.
    """
    rounded: list[float] = np.asarray(values, dtype=np.float32).tolist()
    return rounded
