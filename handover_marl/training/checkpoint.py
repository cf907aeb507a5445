"""Files that a training run goes on from: tensors and numbers, nothing that could run when they are read."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from handover_marl.errors import ResultsError


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write tensors and numbers; a run stopped meanwhile leaves the file that was there before."""
    temporary = path.with_suffix(".part")
    torch.save(state, temporary)
    temporary.replace(path)


def read_checkpoint(path: Path, restore: Callable[[dict[str, Any]], None]) -> None:
    """Hand what `write_checkpoint` wrote to `restore`; a stranger's file cannot run code.

    Raises:
        ResultsError: It is no checkpoint, or not one that `restore` can use.
    """
    try:
        restore(torch.load(path, weights_only=True))
    except Exception as error:  # what damaged files raise has no end
        raise ResultsError(
            f"{path}: no checkpoint of this run ({type(error).__name__}); remove it to start anew"
        ) from error
