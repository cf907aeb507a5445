"""Weights of networks that ship with the library."""

from handover_marl.assets.object_models import DATA_ROOT

#: Those of the receiver `gaddpg`, written by `experiments/train_gaddpg.py` as `policy.npz`; until they ship there is no
#: such file.
GADDPG_WEIGHTS = DATA_ROOT / "gaddpg.npz"

#: Those of the receiver `vision`, written by `experiments/train_vision.py` as `vision.npz`.
VISION_WEIGHTS = DATA_ROOT / "vision.npz"
