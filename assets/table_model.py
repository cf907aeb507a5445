"""The table: HandoverSim's measures, plain boxes."""

from pathlib import Path
from typing import Final

#: Top 1.77 x 0.73 x 0.04 m with its surface at 0.92 m, four legs.
TABLE_URDF: Final = Path(__file__).parent / "data" / "table" / "table.urdf"
