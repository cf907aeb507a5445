"""1000 generated handovers whose statistics follow DexYCB; no license restricts their use.

A scene is a pure function of its number and of `VERSION`. `dataset` chooses subject, object
and hand; `object_placement` the poses on the table and at the handover, and the grasp;
`handover_motion` the timing and the paths; `clutter` the other objects on the table.
"""

from handover_marl.datasets.synthetic.dataset import SyntheticDataset
from handover_marl.datasets.synthetic.random_stream import VERSION

__all__ = ["VERSION", "SyntheticDataset"]
