"""What an import did."""

from dataclasses import dataclass
from pathlib import Path

from handover_marl.datasets.importing.third_party import ARCHIVE


@dataclass(frozen=True)
class Imported:
    """What an import did. `str(imported)` says it.

    Attributes:
        out: The data folder.
        scenes: Numbers of the scenes that are there now, ascending.
        hands: Folders of the hands that are there now.
        faults: What could not be imported, a sentence each that says where, why and what to do.
        notes: What else is worth knowing, likewise.
        lacking: Files of the third-party archive that are not there yet, relative to `assets/`.
        stand_ins: Files that stand in for those of the archive, likewise.
    """

    out: Path
    scenes: tuple[int, ...]
    hands: tuple[str, ...]
    faults: tuple[str, ...]
    notes: tuple[str, ...]
    lacking: tuple[str, ...]
    stand_ins: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether nothing is missing, nor stood in for."""
        return not (self.faults or self.lacking or self.stand_ins)

    def __str__(self) -> str:
        lines = [f"{self.out}: {len(self.scenes)} scenes, {len(self.hands)} hands."]
        lines += [f"not imported: {fault}" for fault in self.faults]
        lines += [f"note: {text}" for text in self.notes]
        if self.stand_ins:
            lines.append(
                f"{len(self.stand_ins)} files stand in for those of {ARCHIVE}, such as {self.stand_ins[0]}; results on "
                "them say so. With --third-party the original ones take their place."
            )
        if self.lacking:
            lines.append(
                f"{len(self.lacking)} files come from neither DexYCB nor MANO, such as {self.lacking[0]}: give "
                f"HandoverSim's {ARCHIVE}, or the folder that it was unpacked into, as --third-party"
            )
        lines.append(f"handover-marl doctor --data-dir {self.out} tells what is there and what it can be used for.")
        return "\n".join(lines)
