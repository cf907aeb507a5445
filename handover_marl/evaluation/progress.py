"""Progress bar of an evaluation, with the success rate so far and a row per finished scene."""

from collections.abc import Collection
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

from handover_marl.evaluation.reports.scene_tables import format_scene_cells
from handover_marl.evaluation.results.episode_result import EpisodeResult

# The sum of the widths fits a terminal of 80 columns.
_COLUMN_WIDTHS = {"scene id": 8, "object name": 22, "subject": 10, "side": 5, "outcome": 15, "steps": 5, "plan s": 6}
_COLORS = {"success": "green", "contact": "red", "drop": "yellow", "timeout": "magenta"}


class BenchmarkProgress:
    """Progress display of an evaluation on stderr.

    Args:
        n_scenes: Number of scenes.
        stored: Results of an earlier run in the same folder, shown first.
    """

    def __init__(self, n_scenes: int, stored: Collection[EpisodeResult] = ()) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True, highlight=False),
        )
        self._task = self._progress.add_task("success   -  ", total=n_scenes)
        self._stored, self._n_scenes = stored, n_scenes
        self._n_finished = self._n_success = 0

    def __enter__(self) -> "BenchmarkProgress":
        self._progress.start()
        self._progress.console.print(_format_row(tuple(_COLUMN_WIDTHS)), style="bold")
        if self._stored:
            text = f"{len(self._stored)} of {self._n_scenes} episodes are from an earlier run in this folder:"
            self._progress.console.print(text, style="dim")
        for result in self._stored:
            self._add(result, "dim")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def add(self, result: EpisodeResult) -> None:
        """Advance the progress bar by a finished scene and print the scene's outcome."""
        self._add(result, _COLORS.get(result.status.label, "red"))

    def _add(self, result: EpisodeResult, style: str) -> None:
        self._n_finished += 1
        self._n_success += result.success
        rate = f"success {100 * self._n_success / self._n_finished:5.1f} %"
        self._progress.update(self._task, advance=1, description=rate)
        scene, name, subject, side, outcome, steps, _, plan_s = format_scene_cells(result)
        cells = (scene, name, subject.partition("-")[2], side, outcome, steps, plan_s)
        self._progress.console.print(_format_row(cells), style=style)


def _format_row(cells: tuple[str, ...]) -> str:
    widths = _COLUMN_WIDTHS.values()
    return " ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()
