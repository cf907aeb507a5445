"""Shards: division of the scenes of an evaluation among several machines, joined again by `merge`."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass

from handover_marl.errors import OptionError

_PATTERN = re.compile(r"(\d{1,4})/(\d{1,4})(?: of (\d{1,7}(?:,\d{1,7})*))?")


@dataclass(frozen=True)
class Shard:
    """Part of an evaluation's scenes, e.g. 3/16 for the third of 16 shards.

    Scenes are distributed in a fixed pseudo-random order, so that objects, people and hands are as
    mixed in every shard as in the whole; the sizes of two shards differ by one scene at most.

    Attributes:
        number: Number of this shard, from 1.
        count: Number of shards.
        scenes: Selected scenes of the whole evaluation, or None for a whole split.
    """

    number: int
    count: int
    scenes: tuple[int, ...] | None = None

    @classmethod
    def parse(cls, text: str, with_scenes: bool = False) -> "Shard":
        """Parse the text of a shard, such as "3/16".

        Args:
            text: Text to parse.
            with_scenes: Whether the text may name the selected scenes, such as "1/2 of 209,214".

        Raises:
            OptionError: The text is not of this form.
        """
        match = _PATTERN.fullmatch(text) if isinstance(text, str) else None
        if match is None or (match[3] and not with_scenes) or not 1 <= int(match[1]) <= int(match[2]):
            shown = text[:80] if isinstance(text, str) else text
            raise OptionError(f"shard must be a number and a count, from 1/N to N/N, such as '3/16', got {shown!r}")
        scenes = None if match[3] is None else tuple(map(int, match[3].split(",")))
        return cls(int(match[1]), int(match[2]), scenes)

    @property
    def name(self) -> str:
        """Number and count as text, e.g. "3/16"."""
        return f"{self.number}/{self.count}"

    def __str__(self) -> str:
        return self.name + ("" if self.scenes is None else f" of {','.join(map(str, self.scenes))}")

    def select(self, scenes: Sequence[int]) -> tuple[int, ...]:
        """Return the scenes of this shard among all scenes, in the same order.

        Raises:
            OptionError: There are fewer scenes than shards.
        """
        if len(scenes) < self.count:
            raise OptionError(
                f"shard {self.name} needs {self.count} scenes or more, got {len(scenes)}; take fewer shards"
            )
        shuffled = sorted(range(len(scenes)), key=lambda position: hashlib.sha256(b"%d" % position).digest())
        return tuple(scenes[position] for position in sorted(shuffled[self.number - 1 :: self.count]))

    def list_positions(self, n_split_scenes: int) -> tuple[int, ...]:
        """Return the scenes of this shard as positions in the split or in the selected scenes.

        Args:
            n_split_scenes: Number of scenes in the split.

        Raises:
            OptionError: There are fewer scenes than shards.
        """
        return self.select(range(n_split_scenes if self.scenes is None else len(self.scenes)))
