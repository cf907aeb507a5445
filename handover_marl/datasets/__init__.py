"""Handover scenes: DexYCB recordings in HandoverSim's folder layout, generated scenes, or scenes of a user's own.

`open_dataset` returns a data set by name. DexYCB is imported from its authors' files by
`handover_marl.datasets.dexycb.importer`.
"""

from handover_marl.datasets.dataset import Dataset
from handover_marl.datasets.official import OfficialDataset
from handover_marl.datasets.registry import AUTO, DATA_DIR_VARIABLE, open_dataset

__all__ = ["AUTO", "DATA_DIR_VARIABLE", "Dataset", "OfficialDataset", "open_dataset"]
