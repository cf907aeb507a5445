"""Statistics of DexYCB, from which quantities of synthetic scenes are drawn.

`dexycb_statistics.json` has the source, the units and a description of every table. For the statistics, scenes with
left hands are mirrored to right hands (positions x -> 2 * MIRROR_X - x, directions x -> -x).
"""

import json
from importlib.resources import files
from types import MappingProxyType

_STATISTICS = json.loads((files(__package__) / "dexycb_statistics.json").read_text())

#: Levels of the quantile tables.
LEVELS: tuple[float, ...] = tuple(_STATISTICS["levels"])

#: Quantile tables by name.
QUANTILES: MappingProxyType[str, tuple[float, ...]] = MappingProxyType(
    {name: tuple(table["values"]) for name, table in _STATISTICS["quantiles"].items()}
)

#: Rank correlations of quantities of the tables.
START_HANDOVER_X, START_HANDOVER_Y, ELEVATION_ROLL = (
    float(_STATISTICS["rank_correlations"][name]) for name in ("start_handover_x", "start_handover_y", "elevation_roll")
)

#: Number of recordings by their length in frames.
FRAME_COUNTS: MappingProxyType[int, int] = MappingProxyType(
    {int(length): count for length, count in _STATISTICS["recordings_by_length"].items()}
)

#: Number of recordings by YCB class and by the object axis that points up on the table: +x, -x, +y, -y, +z, -z.
UP_AXES: MappingProxyType[int, tuple[int, ...]] = MappingProxyType(
    {int(number): tuple(counts) for number, counts in _STATISTICS["recordings_by_class_and_up_axis"].items()}
)

#: Position x (m) of the plane that mirrors left-handed to right-handed givers.
MIRROR_X: float = _STATISTICS["mirror_x"]
