"""A pickle as a stranger might send it."""

import os
from pathlib import Path
from typing import Any


class Evil:
    """Makes a folder when it is unpickled freely."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.marker),)
