"""Files of a data set in LeRobot's format v3 (`meta`, `data`, `videos`), one data file and video per episode."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.errors import ResultsError
from handover_marl.evaluation.demonstrations.data_card import CARD_FILE, DataCard, FeatureRow, count_outcomes
from handover_marl.evaluation.demonstrations.lerobot.arrow_files import (
    decode_table,
    encode_table,
    make_table,
    make_table_of_rows,
)
from handover_marl.evaluation.demonstrations.lerobot.encoded_episode import (
    EncodedEpisode,
    read_statistics,
)
from handover_marl.evaluation.demonstrations.lerobot.features import (
    INDEX_FEATURES,
    VIDEO,
    VIDEO_KEY,
    Feature,
    list_features,
)
from handover_marl.evaluation.demonstrations.lerobot.statistics import merge_statistics
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import ResultMetadata
from handover_marl.execution.files import shorten_text

CODEBASE_VERSION = "v3.0"
#: Files and folders of a data set.
ENTRIES = (CARD_FILE, "data", "meta", "videos")

_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
_TASKS_PATH, _INFO_PATH, _STATISTICS_PATH = "meta/tasks.parquet", "meta/info.json", "meta/stats.json"
_SUMMARY_PATH = "meta/handover_marl.json"
# Files of one folder, and sizes (MB) at which LeRobot's writer begins another file.
_CHUNK_SIZE, _DATA_FILE_MB, _VIDEO_FILE_MB = 1000, 100, 200
_VIDEO_PREFIX = f"videos/{VIDEO_KEY}/"
_VIDEO_INDEX = f"{_VIDEO_PREFIX}file_index"
_INDEX_COLUMNS = ("episode_index", "index", "task_index")
_CONTENTS = """\
[LeRobot](https://github.com/huggingface/lerobot)'s format v3: `meta/info.json`, `meta/episodes`,
`data/*/*.parquet`{videos}. Frames follow at {fps} per second. A frame has the observation of the physics step
(1 ms) nearest to its time and the actions in effect from that step on (zero-order hold of the policies'
decisions). The end of an episode has no action and no frame. `meta/episodes` has scene, object, outcome and
policies of every episode."""


@dataclass(frozen=True)
class DataSetContent:
    """Properties of a data set that its episodes have in common, and their results.

    Attributes:
        evaluation: Identity of the evaluation that was recorded.
        obs_mode: Observation mode of the recorded observations.
        fps: Frames per second.
        simulated: Results of all simulated episodes.
        recorded: Results of the episodes in the data set, in its order.
    """

    evaluation: ResultMetadata
    obs_mode: str
    fps: int
    simulated: Sequence[EpisodeResult]
    recorded: Sequence[EpisodeResult]

    @property
    def features(self) -> tuple[Feature, ...]:
        """Features of a frame."""
        return (*list_features(self.obs_mode), *INDEX_FEATURES)

    @property
    def has_video(self) -> bool:
        """Whether a feature is a video."""
        return any(feature.dtype == VIDEO for feature in self.features)


def write_data_set(folder: Path, content: DataSetContent, episodes: Sequence["EpisodeFiles"]) -> None:
    """Write all files of a data set that `write_description` does not write.

    Args:
        folder: Folder of the data set; its files are overwritten.
        content: Content of the data set except its episodes.
        episodes: Episodes in the order of the data set.

    Raises:
        OSError: A file cannot be written.
        ResultsError: An episode is damaged.
    """
    tasks = sorted({task for episode in episodes for task in episode.row["tasks"]})
    rows: list[dict[str, Any]] = []
    for number, episode in enumerate(episodes):
        table, video = episode.read()
        first = rows[-1]["dataset_to_index"] if rows else 0
        row = _place_episode(episode.row, number, first, content)
        length = row["length"]
        indices = {
            "episode_index": np.full(length, number),
            "index": np.arange(first, first + length),
            "task_index": np.full(length, tasks.index(row["tasks"][0])),
        }
        for name, column in zip(indices, make_table(indices).columns, strict=True):
            table = table.append_column(name, column)
        _write(folder / _format_path(_DATA_PATH, number), encode_table(table))
        if content.has_video:
            _write(folder / _format_path(_VIDEO_PATH, number), video)
        rows.append(row)
    if rows:
        _write(folder / _EPISODES_PATH, encode_table(make_table_of_rows(rows)))
        _write(folder / _TASKS_PATH, _encode_tasks(tasks))
    names = [feature.name for feature in content.features if feature.name not in _INDEX_COLUMNS]
    parts = [read_statistics(row, names) for row in rows]
    statistics = {name: merge_statistics([part[name] for part in parts]) for name in names} if rows else {}
    _write_json(folder / _STATISTICS_PATH, statistics)
    frames = rows[-1]["dataset_to_index"] if rows else 0
    _write_json(folder / _INFO_PATH, _make_info(content, len(rows), frames, len(tasks)))


def write_description(folder: Path, content: DataSetContent, frames: int) -> None:
    """Write the files that describe the whole evaluation: the card and `meta/handover_marl.json`.

    Args:
        folder: Folder of the data set.
        content: Content of the data set except its episodes.
        frames: Number of frames of all episodes.
    """
    outcomes = {name: count_outcomes(getattr(content, name)) for name in ("simulated", "recorded")}
    _write_json(folder / _SUMMARY_PATH, {"evaluation": asdict(content.evaluation), **outcomes})
    videos = ", `videos/*/*/*.mp4` (H.264, lossy)" if content.has_video else ""
    card = DataCard(
        evaluation=content.evaluation,
        format_name=f"LeRobot's format {CODEBASE_VERSION}",
        simulated=content.simulated,
        recorded=content.recorded,
        contents=f"{len(content.recorded)} episodes with {frames} frames. "
        + _CONTENTS.format(videos=videos, fps=content.fps),
        row="frame",
        features=[
            FeatureRow(feature.name, str(feature.shape), feature.dtype, feature.meaning) for feature in content.features
        ],
        arguments=("--format", "lerobot", "--fps", str(content.fps)),
        front_matter="- LeRobot\nconfigs:\n- config_name: default\n  data_files: data/*/*.parquet\n",
    )
    _write(folder / CARD_FILE, card.format().encode())


@dataclass(frozen=True)
class EpisodeFiles:
    """Location of an encoded episode: an archive, or the files of an episode in a data set.

    Attributes:
        path: Path of the archive, or folder of the data set.
        number: Number of the episode in the data set; None for an archive.
        row: Row of the episode in `meta/episodes`.
    """

    path: Path
    number: int | None
    row: dict[str, Any]

    @classmethod
    def from_archive(cls, path: Path) -> "EpisodeFiles":
        """Locate the episode in an archive.

        Raises:
            Exception: The archive does not exist or is damaged.
        """
        return cls(path, None, EncodedEpisode.from_archive(path.read_bytes()).row)

    def read(self) -> tuple[Any, bytes]:
        """Read the frames, a `pyarrow.Table` without index columns, and the video, empty without colours.

        Raises:
            ResultsError: A file is missing or damaged.
        """
        try:
            if self.number is None:
                archive = EncodedEpisode.from_archive(self.path.read_bytes())
                return decode_table(archive.frames), archive.video
            table = decode_table((self.path / _format_path(_DATA_PATH, self.number)).read_bytes())
            video = self.path / _format_path(_VIDEO_PATH, self.number)
            return table.drop_columns(list(_INDEX_COLUMNS)), video.read_bytes() if _VIDEO_INDEX in self.row else b""
        except Exception as error:  # pyarrow and zipfile raise errors of several types
            raise ResultsError(
                f"{self.path}: an episode is damaged ({shorten_text(error)}); remove it and run the same command again "
                "to record its episodes again"
            ) from error


def read_episodes(folder: Path) -> list[EpisodeFiles]:
    """Return the episodes of a data set in its order; empty if there is no data set.

    Raises:
        Exception: A file is damaged.
    """
    path = folder / _EPISODES_PATH
    if not path.exists():
        return []
    return [EpisodeFiles(folder, number, row) for number, row in enumerate(decode_table(path.read_bytes()).to_pylist())]


def _place_episode(row: dict[str, Any], number: int, first: int, content: DataSetContent) -> dict[str, Any]:
    """Return the row of an episode in `meta/episodes`, with its place in the data set."""
    end = first + row["length"]
    chunk, file = divmod(number, _CHUNK_SIZE)
    place = {"data/chunk_index": chunk, "data/file_index": file}
    if content.has_video:
        times = {f"{_VIDEO_PREFIX}from_timestamp": 0.0, f"{_VIDEO_PREFIX}to_timestamp": row["length"] / content.fps}
        place |= {f"{_VIDEO_PREFIX}chunk_index": chunk, _VIDEO_INDEX: file, **times}
    place |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
    return {**row, "episode_index": number, "dataset_from_index": first, "dataset_to_index": end, **place}


def _make_info(content: DataSetContent, episodes: int, frames: int, tasks: int) -> dict[str, Any]:
    return {
        "codebase_version": CODEBASE_VERSION,
        "robot_type": content.evaluation.robot,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": _CHUNK_SIZE,
        "data_files_size_in_mb": _DATA_FILE_MB,
        "video_files_size_in_mb": _VIDEO_FILE_MB,
        "fps": content.fps,
        "splits": {content.evaluation.split: f"0:{episodes}"},
        "data_path": _DATA_PATH,
        "video_path": _VIDEO_PATH if content.has_video else None,
        "features": {feature.name: _describe_feature(feature, content.fps) for feature in content.features},
    }


def _describe_feature(feature: Feature, fps: int) -> dict[str, Any]:
    described: dict[str, Any] = {"dtype": feature.dtype, "shape": feature.shape, "names": feature.names}
    if feature.dtype == VIDEO:
        height, width, channels = feature.shape
        video = {"height": height, "width": width, "codec": "h264", "pix_fmt": "yuv420p", "is_depth_map": False}
        video |= {"fps": fps, "channels": channels}
        described["info"] = {**{f"video.{name}": value for name, value in video.items()}, "has_audio": False}
    return described


def _encode_tasks(tasks: list[str]) -> bytes:
    """Return the content of `meta/tasks.parquet`, a pandas table with the texts as its index."""
    table = make_table_of_rows([{"task_index": number, "task": task} for number, task in enumerate(tasks)])
    types = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype, "metadata": None}
        for name, kind, dtype in types
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    return encode_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}))


def _format_path(pattern: str, number: int) -> str:
    chunk, file = divmod(number, _CHUNK_SIZE)
    return pattern.format(video_key=VIDEO_KEY, chunk_index=chunk, file_index=file)


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def _write_json(path: Path, content: object) -> None:
    _write(path, json.dumps(content, indent=2).encode() + b"\n")
