"""Small JSON files with the outcome of every scene of an evaluation, without the actions.

The key `metadata` holds the identity of the evaluation, `common` the values that all episodes share,
`columns` the keys of the other values, and `episodes` one row for each scene. Keys and units are
those of the episodes in `report.json`.
"""

import json
from collections.abc import Iterable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from handover_marl.episode.metrics.fluency import FluencyMetrics
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import ResultsError
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import ResultMetadata, check_metadata
from handover_marl.evaluation.results.result_folder import check_scenes_differ, parse_result
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import read_plain_file

_MAX_BYTES = 16_000_000
_METRICS = tuple(field.name for field in fields(FluencyMetrics))
_STATUSES = {EpisodeStatus(bits).label: bits for bits in range(1, 16)}


def format_episode_file(metadata: ResultMetadata, episodes: Iterable[EpisodeResult]) -> str:
    """Return the content of an episode file.

    Planning times are rounded to 0.1 ms, and metrics to four significant digits.

    Args:
        metadata: Identity of the evaluation.
        episodes: One result per scene.
    """
    rows = [_describe_result(episode) for episode in episodes]
    common = {key: value for key, value in rows[0].items() if all(row[key] == value for row in rows)}
    common.pop("index", None)  # of an evaluation of one scene
    columns = [key for key in rows[0] if key not in common]
    known = {key: value for key, value in common.items() if value is not None}
    header = {"metadata": metadata.to_dict(), "common": known, "columns": columns}
    lines = ",\n".join(f"  {json.dumps([row[key] for key in columns])}" for row in rows)
    return f'{json.dumps(header, indent=1)[:-2]},\n "episodes": [\n{lines}\n ]\n}}\n'


def read_episode_file(path: Path) -> tuple[ResultMetadata, list[EpisodeResult]]:
    """Read an episode file: the identity of the evaluation, and its results ordered by index.

    Raises:
        ResultsError: The file cannot be read, or its values are impossible.
    """
    try:
        content = json.loads(read_plain_file(path, _MAX_BYTES))
        metadata = ResultMetadata(**content["metadata"])
        rows = [dict(zip(content["columns"], row, strict=True)) | content["common"] for row in content["episodes"]]
        results = [
            parse_result({**row, "status": _STATUSES[row["outcome"]]}, _check_index(row["index"])) for row in rows
        ]
        if not rows or len({result.index for result in results}) < len(rows):
            raise ValueError("episodes must have at least one row, and each index once")
    except Exception as error:  # the file may have any content
        raise ResultsError(
            f"{path}: not a readable episode file ({type(error).__name__}: {shorten_text(error)}); pass a result "
            "folder, or a file of docs/results/data/episodes"
        ) from error
    check_metadata(metadata, path)
    check_scenes_differ(results, path)
    return metadata, sorted(results, key=lambda result: result.index)


def _describe_result(episode: EpisodeResult) -> dict[str, Any]:
    values = asdict(episode)
    fluency = values.pop("fluency") or dict.fromkeys(_METRICS)
    metrics = {key: None if value is None else float(f"{value:.4g}") for key, value in fluency.items()}
    outcome = EpisodeStatus(values.pop("status")).label
    # The cells that most readers look for come first.
    first = {key: values.pop(key) for key in ("index", "scene_id")}
    return {**first, "outcome": outcome, **values, "plan_s": round(episode.plan_s, 4), **metrics}


def _check_index(index: Any) -> int:
    if type(index) is not int or index < 0:
        raise ValueError(f"index must be a whole number of at least 0, got {index!r}")
    return index
