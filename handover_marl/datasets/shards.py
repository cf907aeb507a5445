"""Shards: the scenes of a run dealt out to several machines, and put together again by `handover-marl merge`."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass

from handover_marl.datasets.splits import SPLIT_SIZES
from handover_marl.errors import OptionError

_TEXT = re.compile(r"(\d{1,4})/(\d{1,4})")
_TOLD = re.compile(rf"{_TEXT.pattern}(?: of (\d{{1,3}}(?:,\d{{1,3}})*))?")


@dataclass(frozen=True)
class Shard:
    """Which part of how many.

    Scenes are dealt out in an order of their own, like shuffled cards, so that objects, people and hands are as mixed
    in every shard as in the whole; two shards differ by one scene at most.

    Attributes:
        number: Which one, from 1.
        count: How many there are.
    """

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """From a text such as "3/16".

        Raises:
            OptionError: It is none.
        """
        match = _TEXT.fullmatch(text) if isinstance(text, str) else None
        if match is None or not 1 <= int(match[1]) <= int(match[2]):
            raise OptionError(f"shard={text!r} must be which of how many, from 1/N to N/N, such as '3/16'")
        return cls(int(match[1]), int(match[2]))

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def of(self, scenes: Sequence[int]) -> tuple[int, ...]:
        """The scenes of this shard, in their order.

        Raises:
            OptionError: There are fewer scenes than shards.
        """
        if len(scenes) < self.count:
            raise OptionError(f"shard {self}: there are only {len(scenes)} scenes; take {len(scenes)} shards at most")
        dealt = sorted(range(len(scenes)), key=lambda place: hashlib.sha256(b"%d" % place).digest())
        return tuple(scenes[place] for place in sorted(dealt[self.number - 1 :: self.count]))


@dataclass(frozen=True)
class ShardOfRun:
    """A shard and what it is one of, as result folders tell it.

    Attributes:
        shard: Which one.
        scenes: The scenes of the whole run where they are chosen ones, or None where it is a whole split.
    """

    shard: Shard
    scenes: tuple[int, ...] | None = None

    @classmethod
    def parse(cls, text: str) -> "ShardOfRun":
        """From what `str` gives.

        Raises:
            OptionError: It is no such text.
        """
        match = _TOLD.fullmatch(text)
        if match is None:
            raise OptionError(f"{text[:80]!r} tells no shard")
        chosen = None if match[3] is None else tuple(map(int, match[3].split(",")))
        return cls(Shard.parse(f"{match[1]}/{match[2]}"), chosen)

    def __str__(self) -> str:
        return str(self.shard) + ("" if self.scenes is None else f" of {','.join(map(str, self.scenes))}")

    def places(self, setup: str, split: str) -> dict[int, int | None]:
        """What this shard holds: positions in the split, or -1 - n for the n-th chosen scene, and scene numbers.

        Raises:
            OptionError: There are fewer scenes than shards.
        """
        if self.scenes is None:
            return dict.fromkeys(self.shard.of(range(SPLIT_SIZES[setup, split])))
        return {-1 - place: self.scenes[place] for place in self.shard.of(range(len(self.scenes)))}
