"""Object for tests of untrusted pickles."""

import os
from pathlib import Path
from typing import Any


class Evil:
    """Object that makes a folder if it is unpickled without restrictions."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.marker),)
