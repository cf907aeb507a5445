"""How far other physics can be trusted: the same receiver on the same scenes in exact physics and in these."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from typing_extensions import Unpack

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.report import FAILURES, Report
from handover_marl.benchmarking.runner import evaluate_run
from handover_marl.benchmarking.tables import NO_VALUE, percent_interval, players, report_extent, table
from handover_marl.errors import UnknownNameError
from handover_marl.files import write_atomically
from handover_marl.options import shows
from handover_marl.policies.reference import PolicyLike
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.run import REPLAY, Execution, Run, RunOptions, describe
from handover_marl.sim.engines import EXACT, FAST, PHYSICS, check_physics

AGREEMENT_FILE = "agreement.md"


@dataclass(frozen=True)
class Agreement:
    """The outcomes of exact and other physics side by side. `str(agreement)` is the table.

    Attributes:
        exact: Report of the run in exact physics.
        other: Report of the same scenes in other physics.
    """

    exact: Report
    other: Report

    @property
    def against(self) -> str:
        """The other physics."""
        return self.other.settings.physics

    @property
    def n_agreed(self) -> int:
        """Scenes with the same status."""
        return sum(exact.status == other.status for exact, other in self._pairs())

    @property
    def rate(self) -> float:
        """Share of scenes with the same status (0..1)."""
        return self.n_agreed / len(self.exact.episodes)

    def step_differences(self) -> list[int]:
        """Steps in the other minus steps in exact physics, of the scenes with the same status."""
        return [other.steps - exact.steps for exact, other in self._pairs() if exact.status == other.status]

    def confusion(self) -> Counter[tuple[str, str]]:
        """How many scenes ended how in exact and how in the other physics."""
        return Counter((exact.status.label, other.status.label) for exact, other in self._pairs())

    def __str__(self) -> str:
        parts = [self._heading(), self._confusion_table(), self._rate_table(), self._differences()]
        return "\n\n".join(part for part in parts if part)

    def _pairs(self) -> list[tuple[EpisodeResult, EpisodeResult]]:
        return list(zip(self.exact.episodes, self.other.episodes, strict=True))

    def _heading(self) -> str:
        settings, n = self.exact.settings, len(self.exact.episodes)
        return (
            f"{settings.setup} {settings.split}, {report_extent(self.exact)}. Receiver {players(settings)}, "
            f"data: {self.exact.data_label()}.\n"
            f"Exact and {self.against} physics agree on the outcome of {self.n_agreed} of {n} scenes: "
            f"{100 * self.rate:.2f} % (95 % interval {percent_interval(self.n_agreed, n)})."
        )

    def _confusion_table(self) -> str:
        counts = self.confusion()
        labels = sorted({label for pair in counts for label in pair})
        rows = [[f"exact: {exact}", *(counts[exact, other] for other in labels)] for exact in labels]
        return table(["", *(f"{self.against}: {label}" for label in labels)], rows)

    def _rate_table(self) -> str:
        rows = []
        for flag in (EpisodeStatus.SUCCESS, *FAILURES):
            n = len(self.exact.episodes)
            exact, other = (100 * report.count(flag) / n for report in (self.exact, self.other))
            rows.append([flag.label, f"{exact:.2f}", f"{other:.2f}", f"{other - exact:+.2f}"])
        return table(["rate %", "exact", self.against, "difference"], rows)

    def _differences(self) -> str:
        lines = []
        differences = np.abs(self.step_differences())
        if len(differences):
            middle, most = np.percentile(differences, [50, 95])
            lines.append(
                f"Where they agree, {np.mean(differences == 0):.0%} of the episodes are equally long. Lengths "
                f"differ by {middle:g} steps (ms) in the median, {most:g} or less in 95 %, {differences.max()} at "
                "most."
            )
        rows = [
            [
                exact.scene_id,
                exact.object_name or NO_VALUE,
                exact.status.label,
                exact.steps,
                _step(exact.release_step),
                other.status.label,
                other.steps,
                _step(other.release_step),
            ]
            for exact, other in self._pairs()
            if exact.status != other.status
        ]
        if rows:
            header = ["scene", "object", "exact", "steps", "release", self.against, "steps", "release"]
            lines.append(table(header, rows))
        return "\n\n".join(lines)


def _step(release_step: int | None) -> str:
    return NO_VALUE if release_step is None else str(release_step)


@shows(Run, Execution)
def agreement(
    setup: str | Run = "s0",
    split: str = "val",
    receiver: PolicyLike = "yang2021",
    giver: PolicyLike = REPLAY,
    against: str = FAST,
    execution: Execution | None = None,
    **options: Unpack[RunOptions],
) -> Agreement:
    """Play the same scenes in exact and in other physics.

    Args:
        setup: Official setup, "s0" to "s3"; or a whole `handover_marl.Run`, whose physics do not count.
        split: "train", "val" or "test".
        receiver: As in `benchmark`.
        giver: As in `evaluate_pair`.
        against: The other physics, "fast" or "mujoco".
        execution: How to run. Its folder gets the result folders `exact` and, say, `fast`, and `agreement.md`.
        options: The fields of `handover_marl.Run` and `handover_marl.Execution`.

    Raises:
        UnknownNameError: There are no such other physics.
        HandoverError: As `evaluate_pair` does.
    """
    others = [physics for physics in PHYSICS if physics != EXACT]
    if against not in others:
        raise UnknownNameError("physics to compare with exact", against, others)
    check_physics(against)
    run, how = describe(setup, options, execution, split=split, receiver=receiver, giver=giver)
    exact, other = (evaluate_run(replace(run, physics=physics), how.inside(physics)) for physics in (EXACT, against))
    result = Agreement(exact, other)
    if how.folder is not None:
        write_agreement(how.folder, result)
    return result


def write_agreement(folder: Path, result: Agreement) -> None:
    """Write the table.

    Raises:
        ResultsError: The folder cannot be written.
    """
    write_atomically(folder / AGREEMENT_FILE, f"# Exact and {result.against} physics\n\n{result}\n")
