"""The file of a data set: put together from episodes that lie elsewhere, packed as they are."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from handover_marl.demonstrations.hdf5 import open_hdf5
from handover_marl.demonstrations.minari_layout import group_name
from handover_marl.files import written_whole


@dataclass(frozen=True)
class EpisodePlace:
    """Where an episode is: a file, and the group in it."""

    file: Path
    group: str


def put_together(main: Path, places: Sequence[EpisodePlace]) -> None:
    """Write a data set's file, with episodes in this order.

    Raises:
        ResultsError: It cannot be written.
    """
    with written_whole(main) as temporary:
        _copy(places, temporary)


def _copy(places: Sequence[EpisodePlace], target: Path) -> None:
    with open_hdf5(target, "w") as made:
        for number, place in enumerate(places):
            with open_hdf5(place.file, "r") as source:
                source.copy(source[place.group], made, name=group_name(number))
            made[group_name(number)].attrs["id"] = number


def size_of(main: Path) -> dict[str, Any]:
    """How much is in a data set's file, as `DataSetFacts` tells it: decisions and megabytes."""
    with open_hdf5(main, "r") as file:
        decisions = sum(int(file[name].attrs["total_steps"]) for name in file)
    return {"decisions": decisions, "megabytes": round(main.stat().st_size / 1e6, 1)}


def outcomes(labels: Iterable[str]) -> dict[str, int]:
    """How many episodes ended how, as `DataSetFacts` tells it."""
    return dict(sorted(Counter(labels).items()))
