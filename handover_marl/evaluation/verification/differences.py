"""Differences between stored and simulated results."""

import math
from dataclasses import dataclass, fields
from typing import Any

from handover_marl import __version__
from handover_marl.evaluation.reports.tables import ReportTable, TabularResult
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import ResultMetadata

# Fields of a result that cannot be simulated: wall-clock times and the machine they were measured on.
_UNVERIFIED = ("plan_s", "machine")
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Difference:
    """Value of a result folder that differs from the simulated or expected one.

    Attributes:
        key: Name of the value.
        stored: Value in the folder, as text.
        expected: Value that was simulated or computed, as text.
    """

    key: str
    stored: str
    expected: str


@dataclass(frozen=True)
class EpisodeCheck:
    """Comparison of one stored episode with its simulation.

    Attributes:
        index: Position of the scene in its split.
        scene_id: Scene number.
        differences: Values that differ; empty if the episode is verified.
    """

    index: int
    scene_id: int
    differences: tuple[Difference, ...]


@dataclass(frozen=True)
class Verification(TabularResult):
    """Result of verifying a result folder. `str(verification)` is text with a Markdown table.

    Attributes:
        metadata: Identity of the evaluation, as the folder states it.
        episodes: One comparison per stored episode, in the split's order.
        folder_differences: Differences of the folder's reports and policies.
        n_split_scenes: Number of scenes in the whole split.
    """

    metadata: ResultMetadata
    episodes: tuple[EpisodeCheck, ...]
    folder_differences: tuple[Difference, ...]
    n_split_scenes: int

    @property
    def is_verified(self) -> bool:
        """Whether nothing in the folder differs."""
        return not self.folder_differences and not self.changed_episodes

    @property
    def changed_episodes(self) -> tuple[EpisodeCheck, ...]:
        """Episodes with at least one difference."""
        return tuple(episode for episode in self.episodes if episode.differences)

    def build_sections(self) -> list[str | ReportTable]:
        """Build the description of what was verified, the table of differences and the conclusion."""
        metadata, n = self.metadata, len(self.episodes)
        rows = [["folder", *_format_cells(difference)] for difference in self.folder_differences]
        for episode in self.changed_episodes:
            rows += [[str(episode.scene_id), *_format_cells(difference)] for difference in episode.differences]
        parts: list[str | ReportTable] = [
            f"{metadata.setup} {metadata.split}, {metadata.dataset}, receiver {metadata.receiver}, giver "
            f"{metadata.giver}, {metadata.physics} physics, handover_marl {metadata.version}: {n} of "
            f"{self.n_split_scenes} scenes simulated again from their stored actions.",
            "Not verified: planning times, and that the actions are those of the named receiver.",
        ]
        if metadata.version != __version__:
            parts.append(
                f"Not compared, because version {metadata.version} wrote them: report.md, report.html, episodes.csv "
                "and hashes."
            )
        if rows:
            parts.append(ReportTable(["scene id", "value", "stored", "simulated"], rows, n_keys=2))
            n_changed, n_folder = len(self.changed_episodes), len(self.folder_differences)
            parts.append(f"Not equal: {n_changed} of {n} episodes and {n_folder} values of the folder.")
        else:
            parts.append(f"Verified: all {n} episodes are equal.")
        n_absent = self.n_split_scenes - n
        if n_absent:
            parts.append(f"{n_absent} of {self.n_split_scenes} scenes of the split were not simulated.")
        return parts


def compare_results(stored: EpisodeResult, simulated: EpisodeResult, same_version: bool) -> list[Difference]:
    """Compare a stored result with the simulated one; values that are not stored are skipped.

    Args:
        stored: Result in the folder.
        simulated: Result of simulating the stored actions.
        same_version: Whether the present version of the library made the folder; other versions may
            compute hashes of data and descriptions of models differently, and lack metrics.
    """
    skipped = (*_UNVERIFIED, "fluency", *(() if same_version else ("fingerprint", "models")))
    pairs = {
        field.name: (getattr(stored, field.name), getattr(simulated, field.name))
        for field in fields(EpisodeResult)
        if field.name not in skipped
    }
    is_official = stored.scene_id is None
    differences = []
    for key, (found, expected) in pairs.items():
        # Files of HandoverSim hold the official values only.
        if found != expected and not (is_official and found is None):
            differences.append(_make_difference(key, found, expected))
    if stored.fluency is not None and simulated.fluency is not None:
        for field in fields(stored.fluency):
            found, expected = getattr(stored.fluency, field.name), getattr(simulated.fluency, field.name)
            is_new = field.default is None and found is None  # version 0.7.0 lacks metrics that have a default
            if not _is_close(found, expected) and (same_version or not is_new):
                differences.append(_make_difference(field.name, found, expected))
    elif stored.fluency is None and not is_official:
        differences.append(Difference("fluency", "missing", "present"))
    return differences


def compare_json(stored: Any, expected: Any, key: str = "", same_keys: bool = True) -> list[Difference]:
    """Compare two values of JSON types; numbers may differ by rounding.

    Args:
        stored: Value in a file.
        expected: Computed value.
        key: Name of the value.
        same_keys: Whether keys that only one of the two values has are differences.
    """
    if isinstance(stored, dict) and isinstance(expected, dict):
        names = sorted(stored.keys() | expected.keys() if same_keys else stored.keys() & expected.keys())
        parts = [
            compare_json(stored.get(name), expected.get(name), f"{key}.{name}".lstrip("."), same_keys) for name in names
        ]
    elif isinstance(stored, list) and isinstance(expected, list) and len(stored) == len(expected):
        pairs = enumerate(zip(stored, expected, strict=True))
        parts = [compare_json(found, wanted, f"{key}[{index}]", same_keys) for index, (found, wanted) in pairs]
    else:
        return [] if _is_close(stored, expected) else [_make_difference(key, stored, expected)]
    return [difference for part in parts for difference in part]


def _is_close(first: Any, second: Any) -> bool:
    numbers = (int, float)
    if type(first) is bool or type(second) is bool or not isinstance(first, numbers) or not isinstance(second, numbers):
        return bool(first == second)
    return math.isclose(first, second, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE)


def _make_difference(key: str, stored: object, expected: object) -> Difference:
    return Difference(key, _format_value(stored), _format_value(expected))


def _format_value(value: object) -> str:
    if value is None:
        return "none"
    label = getattr(value, "label", None)
    text = label if isinstance(label, str) else f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _format_cells(difference: Difference) -> list[str]:
    return [difference.key, difference.stored, difference.expected]
