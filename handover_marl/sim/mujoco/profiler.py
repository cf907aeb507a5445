"""MuJoCo's profiler, which its Python package leaves running: it looks at the clock many times in every step."""

import ctypes
from pathlib import Path

import mujoco

_LIBRARIES = ("libmujoco*.so*", "libmujoco*.dylib", "mujoco.dll")


def stop_profiler() -> bool:
    """Stop it in this process, which makes steps a sixteenth faster and changes nothing else.

    `mujoco.MjData.timer` stays at zero then; `mujoco.set_mjcb_time(None)` starts the profiler again. A clock that
    somebody gave to `mujoco.set_mjcb_time` is left alone.

    Returns:
        Whether it was stopped; False where the engine's library is not where it is expected.
    """
    if mujoco.get_mjcb_time() is not None:
        return False
    folder = Path(mujoco.__file__).parent
    for library in (path for pattern in _LIBRARIES for path in sorted(folder.glob(pattern))):
        try:
            # The package offers no way to say "none": it puts its own clock in the place of None.
            clock = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "mjcb_time")
        except (OSError, ValueError):
            continue
        clock.value = None
        return True
    return False
