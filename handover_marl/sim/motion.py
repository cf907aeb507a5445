"""Where the giver's side leads hand and objects: what worlds are told, step by step."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, eq=False)
class Motion:
    """Where hand and objects are led in each of n physics steps (world frame, m, rad).

    Attributes:
        objects: (n, m, 6) float32 joint targets of the m objects, in the scene's order.
        hand: (n, 51) float32 joint targets.
        hand_present: (n,) whether there is a hand at all.
    """

    objects: npt.NDArray[np.float32]
    hand: npt.NDArray[np.float32]
    hand_present: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.objects)

    def hand_targets(self) -> list[list[float] | None]:
        """The hand's targets as lists of floats, None where there is no hand."""
        return [
            row if present else None
            for row, present in zip(self.hand.tolist(), self.hand_present.tolist(), strict=True)
        ]
