"""A progress bar with the running success rate, and a row for every scene."""

from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.tables import NO_VALUE

# Together narrower than a terminal of 80 columns.
_COLUMNS = {"scene": 5, "object": 22, "subject": 10, "hand": 5, "outcome": 15, "steps": 5, "plan s": 6}
_COLOURS = {"success": "green", "contact": "red", "drop": "yellow", "timeout": "magenta"}


class BenchmarkProgress:
    """Shows how a benchmark gets on, on stderr.

    Args:
        n_scenes: How many scenes there are.
        shown: Whether to show anything.
    """

    def __init__(self, n_scenes: int, shown: bool) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True, highlight=False),
            disable=not shown,
        )
        self._shown = shown
        self._n_scenes = n_scenes
        self._n_done = self._n_success = 0

    def __enter__(self) -> "BenchmarkProgress":
        self._progress.start()
        self._task = self._progress.add_task("success   -  ", total=self._n_scenes)
        if self._shown:
            self._progress.console.print(_row(tuple(_COLUMNS)), style="bold")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def add(self, result: EpisodeResult, known: bool) -> None:
        """Count a finished scene; `known` ones come from an earlier run."""
        self._n_done += 1
        self._n_success += result.success
        rate = f"success {100 * self._n_success / self._n_done:5.1f} %"
        self._progress.update(self._task, advance=1, description=rate)
        if self._shown:
            style = "dim" if known else _COLOURS.get(result.status.label, "red")
            self._progress.console.print(_row(_cells(result)), style=style)


def _cells(result: EpisodeResult) -> tuple[str, ...]:
    subject = (result.subject or NO_VALUE).partition("-")[2]
    return (
        str(result.scene_id),
        result.object_name or NO_VALUE,
        subject,
        result.side or NO_VALUE,
        result.status.label,
        str(result.steps),
        f"{result.plan_time:.3f}",
    )


def _row(cells: tuple[str, ...]) -> str:
    widths = _COLUMNS.values()
    return " ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()
