"""A thousand generated handovers, free of any licence, shaped like DexYCB's.

A scene is a pure function of its number and `VERSION`: who gives what with which hand (`casting`), how the object
lies and is held and offered (`staging`), what else stands on the table (`clutter`), and when and along which way
everything moves (`motion`). Distributions are calibrated on aggregate figures of DexYCB (`calibration`).
"""

from handover_marl.datasets.synthetic.draws import VERSION
from handover_marl.datasets.synthetic.synthetic_dataset import SyntheticDataset

__all__ = ["VERSION", "SyntheticDataset"]
