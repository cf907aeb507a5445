"""How far fast physics can be trusted: the same receiver on the same scenes in both kinds of physics."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from typing_extensions import Unpack

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.report import FAILURES, Report
from handover_marl.benchmarking.runner import evaluate_run
from handover_marl.benchmarking.tables import NO_VALUE, percent_interval, players, report_extent, table
from handover_marl.files import write_atomically
from handover_marl.options import shows
from handover_marl.policies.reference import PolicyLike
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.run import REPLAY, Execution, Run, RunOptions, describe


@dataclass(frozen=True)
class Agreement:
    """The outcomes of exact and fast physics side by side. `str(agreement)` is the table.

    Attributes:
        exact: Report of the run in exact physics.
        fast: Report of the same scenes in fast physics.
    """

    exact: Report
    fast: Report

    @property
    def n_agreed(self) -> int:
        """Scenes with the same status."""
        return sum(exact.status == fast.status for exact, fast in self._pairs())

    @property
    def rate(self) -> float:
        """Share of scenes with the same status (0..1)."""
        return self.n_agreed / len(self.exact.episodes)

    def step_differences(self) -> list[int]:
        """Steps in fast minus steps in exact physics, of the scenes with the same status."""
        return [fast.steps - exact.steps for exact, fast in self._pairs() if exact.status == fast.status]

    def confusion(self) -> Counter[tuple[str, str]]:
        """How many scenes ended how in exact and how in fast physics."""
        return Counter((exact.status.label, fast.status.label) for exact, fast in self._pairs())

    def __str__(self) -> str:
        parts = [self._heading(), self._confusion_table(), self._rate_table(), self._differences()]
        return "\n\n".join(part for part in parts if part)

    def _pairs(self) -> list[tuple[EpisodeResult, EpisodeResult]]:
        return list(zip(self.exact.episodes, self.fast.episodes, strict=True))

    def _heading(self) -> str:
        settings, n = self.exact.settings, len(self.exact.episodes)
        return (
            f"{settings.setup} {settings.split}, {report_extent(self.exact)}. Receiver {players(settings)}, "
            f"data: {self.exact.data_label()}.\n"
            f"Exact and fast physics agree on the outcome of {self.n_agreed} of {n} scenes: "
            f"{100 * self.rate:.2f} % (95 % interval {percent_interval(self.n_agreed, n)})."
        )

    def _confusion_table(self) -> str:
        counts = self.confusion()
        labels = sorted({label for pair in counts for label in pair})
        rows = [[f"exact: {exact}", *(counts[exact, fast] for fast in labels)] for exact in labels]
        return table(["", *(f"fast: {label}" for label in labels)], rows)

    def _rate_table(self) -> str:
        rows = []
        for flag in (EpisodeStatus.SUCCESS, *FAILURES):
            n = len(self.exact.episodes)
            exact, fast = (100 * report.count(flag) / n for report in (self.exact, self.fast))
            rows.append([flag.label, f"{exact:.2f}", f"{fast:.2f}", f"{fast - exact:+.2f}"])
        return table(["rate %", "exact", "fast", "difference"], rows)

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
                fast.status.label,
                fast.steps,
                _step(fast.release_step),
            ]
            for exact, fast in self._pairs()
            if exact.status != fast.status
        ]
        if rows:
            header = ["scene", "object", "exact", "steps", "release", "fast", "steps", "release"]
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
    execution: Execution | None = None,
    **options: Unpack[RunOptions],
) -> Agreement:
    """Play the same scenes in exact and in fast physics.

    Args:
        setup: Official setup, "s0" to "s3"; or a whole `handover_marl.Run`, whose physics do not count.
        split: "train", "val" or "test".
        receiver: As in `benchmark`.
        giver: As in `evaluate_pair`.
        execution: How to run. Its folder gets the result folders `exact` and `fast` and `agreement.md`.
        options: The fields of `handover_marl.Run` and `handover_marl.Execution`.

    Raises:
        HandoverError: As `evaluate_pair` does.
    """
    run, how = describe(setup, options, execution, split=split, receiver=receiver, giver=giver)
    exact, fast = (evaluate_run(replace(run, physics=physics), how.inside(physics)) for physics in ("exact", "fast"))
    result = Agreement(exact, fast)
    if how.folder is not None:
        write_atomically(how.folder / "agreement.md", f"# Exact and fast physics\n\n{result}\n")
    return result
