"""Where a data folder is on another machine than the one where it was named."""

import os
from dataclasses import dataclass
from pathlib import Path
from platform import node

from handover_marl.datasets import DATA_VARIABLE
from handover_marl.errors import DataFormatError

#: What to do where there is none, or another.
ADVICE = (
    f"Machines share no files: every node needs the same data folder, at the same path or named by {DATA_VARIABLE} "
    "in the environment that Ray was started in there."
)


@dataclass(frozen=True)
class DataPlace:
    """The data folder as the machine that it was named on has it.

    Attributes:
        given: The folder that was given as an argument, absolute; empty if none was.
        usual: The one that `HANDOVER_MARL_DATA` named there; likewise.
    """

    given: str = ""
    usual: str = ""

    @classmethod
    def of(cls, data_dir: str | None) -> "DataPlace":
        """On this machine, where a run has it."""
        return cls(_absolute(data_dir), _absolute(os.environ.get(DATA_VARIABLE)))

    def here(self) -> str | None:
        """The folder to take on this machine, or None for the one that its own `HANDOVER_MARL_DATA` names.

        That which was given if it is there, else this machine's own, else the usual one of the other machine.
        """
        if self.given and Path(self.given).is_dir():
            return self.given
        if not os.environ.get(DATA_VARIABLE) and self.usual and Path(self.usual).is_dir():
            return self.usual
        return None


def check_scene(scene_id: int, found: str, asked: str) -> None:
    """Look whether a scene of this machine is that of the machine that asks for it.

    Args:
        scene_id: Which.
        found: Its fingerprint here.
        asked: Its fingerprint there; empty if any will do.

    Raises:
        DataFormatError: It is another.
    """
    if asked not in ("", found):
        raise DataFormatError(
            f"scene {scene_id} on {node()} is not the one that was asked for (fingerprint {found} there, {asked} "
            f"here). {ADVICE}"
        )


def _absolute(folder: str | None) -> str:
    return str(Path(folder).expanduser().resolve()) if folder else ""
