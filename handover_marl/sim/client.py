"""Connections to PyBullet and the loading of model files."""

import contextlib
import functools
import inspect
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.errors import SimulationError


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Send what C code writes to stderr nowhere: PyBullet greets with its build time."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


with _silenced():
    import pybullet


class BulletClient:
    """PyBullet's functions and constants, bound to a physics server of its own.

    Disconnects when it is collected. It must not be copied: two holders would close one server twice.
    """

    def __init__(self, mode: int) -> None:
        self._server = pybullet.connect(mode)
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
        """Disconnect; safe to call twice."""
        if self._server >= 0:
            pybullet.disconnect(physicsClientId=self._server)
            self._server = -1

    def __del__(self) -> None:
        if getattr(self, "_server", -1) >= 0:
            with contextlib.suppress(pybullet.error):
                self.close()


def connect(window: bool = False) -> BulletClient:
    """A physics server of its own in this process, with PyBullet's window if asked for.

    Raises:
        SimulationError: A window was asked for where there is no screen.
    """
    if window and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        # Without this check PyBullet ends the whole process.
        raise SimulationError(
            'render_mode="human" opens a window and needs a screen, but DISPLAY is not set. '
            'Use render_mode="rgb_array", or start the program under xvfb-run.'
        )
    return BulletClient(pybullet.GUI if window else pybullet.DIRECT)


def load_urdf(client: BulletClient, path: Path | str, **options: object) -> int:
    """Load a model file and return its body id.

    Raises:
        SimulationError: PyBullet cannot load it.
    """
    try:
        return int(client.loadURDF(str(path), **options))
    except pybullet.error as error:
        raise SimulationError(
            f"{path}: PyBullet cannot load this model ({error}); check the file and its meshes"
        ) from error


def float32_list(values: Sequence[float]) -> list[float]:
    """Values rounded to float32, as plain floats.

    The reference hands every target, gain and pose over as float32, so Bullet must see those bits.
    """
    rounded: list[float] = np.asarray(values, dtype=np.float32).tolist()
    return rounded
