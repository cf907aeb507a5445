"""Weights of networks that ship with the library."""

from pathlib import Path

from handover_marl.assets.object_models import DATA_ROOT

#: Those of the receiver `gaddpg`, learned from scenes that are in the training splits of all official setups; written
#: by `experiments/train_gaddpg.py` as `policy.npz`.
GADDPG_WEIGHTS = DATA_ROOT / "gaddpg.npz"


def vision_weights(setup: str) -> Path:
    """Those of the receiver `vision` for an official setup, learned from its training split alone.

    Written by `experiments/train_vision.py` as `vision.npz`; for another setup there is no such file.
    """
    return DATA_ROOT / f"vision_{setup}.npz"
