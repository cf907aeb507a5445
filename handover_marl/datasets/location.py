"""Location of the data folder on worker machines, where its path may differ from the main machine's."""

import os
from dataclasses import dataclass
from pathlib import Path
from platform import node

from handover_marl.datasets import DATA_DIR_VARIABLE
from handover_marl.errors import DataFormatError

#: Advice for a machine whose data folder is missing or differs.
DATA_FOLDER_ADVICE = (
    f"Machines share no files: every node needs the same data folder, at the same path or named by {DATA_DIR_VARIABLE} "
    "in the environment that Ray was started in there."
)


@dataclass(frozen=True)
class DataLocation:
    """Data folder as known to the machine that starts an evaluation.

    Attributes:
        argument: Absolute path of the folder passed as an argument, or "" if none was.
        environment: Absolute path in the environment variable `HANDOVER_MARL_DATA` of that machine,
            or "" if it is not set or does not apply.
    """

    argument: str = ""
    environment: str = ""

    @classmethod
    def from_data_dir(cls, data_dir: str | None, dataset: str = "dexycb") -> "DataLocation":
        """Return the location for the arguments `data_dir` and `dataset` on this machine."""
        # The variable names the folder of DexYCB only.
        environment = os.environ.get(DATA_DIR_VARIABLE) if dataset == "dexycb" else None
        return cls(_resolve_path(data_dir), _resolve_path(environment))

    def resolve(self) -> str | None:
        """Return the folder to use on this machine.

        The order of preference is: `argument` if it exists on this machine, `HANDOVER_MARL_DATA` of
        this machine, `environment`.

        Returns:
            Path of the folder, or None to use this machine's `HANDOVER_MARL_DATA`.
        """
        if self.argument and Path(self.argument).is_dir():
            return self.argument
        if not os.environ.get(DATA_DIR_VARIABLE) and self.environment and Path(self.environment).is_dir():
            return self.environment
        return None


def check_scene_fingerprint(scene_id: int, found: str, expected: str) -> None:
    """Check that a scene on this machine equals the scene on the main machine, which starts the evaluation.

    Args:
        scene_id: Number of the scene.
        found: Fingerprint on this machine.
        expected: Fingerprint on the main machine; "" accepts any.

    Raises:
        DataFormatError: The fingerprints differ.
    """
    if expected not in ("", found):
        raise DataFormatError(
            f"scene {scene_id} on {node()} differs from the requested one (fingerprint {found} there, {expected} "
            f"here). {DATA_FOLDER_ADVICE}"
        )


def _resolve_path(folder: str | None) -> str:
    return str(Path(folder).expanduser().resolve()) if folder else ""
