"""Episode of a data set in LeRobot's format, encoded as one archive until the data set is assembled."""

import io
import json
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.evaluation.demonstrations.demonstration import EpisodeMetadata
from handover_marl.evaluation.demonstrations.lerobot.arrow_files import encode_table, encode_video, make_table
from handover_marl.evaluation.demonstrations.lerobot.features import VIDEO_KEY, format_task
from handover_marl.evaluation.demonstrations.lerobot.statistics import FeatureStatistics, compute_statistics

# Prefix of a feature's statistics in an episode's row.
_STATISTICS_PREFIX = "stats"
_ROW, _FRAMES, _VIDEO = "row.json", "frames.parquet", "video.mp4"


@dataclass(frozen=True)
class EncodedEpisode:
    """Episode as the contents of its files, without its place in the data set.

    Attributes:
        row: Values of the episode in `meta/episodes`: task, length, `EpisodeMetadata`, statistics.
        frames: Content of a Parquet file with one row for each frame.
        video: Content of an MP4 file; empty without colours.
    """

    row: dict[str, Any]
    frames: bytes
    video: bytes = b""

    @classmethod
    def from_columns(
        cls, columns: Mapping[str, npt.NDArray[Any]], metadata: EpisodeMetadata, fps: int
    ) -> "EncodedEpisode":
        """Encode the frames of an episode.

        Args:
            columns: Arrays (T, ...) of all features by name.
            metadata: Scene, policies and outcome.
            fps: Frames per second.
        """
        columns = dict(columns)
        length = len(next(iter(columns.values())))
        frame_index = np.arange(length)
        columns |= {"timestamp": (frame_index / fps).astype(np.float32), "frame_index": frame_index}
        statistics = {name: compute_statistics(values, name == VIDEO_KEY) for name, values in columns.items()}
        colors = columns.pop(VIDEO_KEY, None)
        row: dict[str, Any] = {"tasks": [format_task(metadata.object_name)], "length": length}
        row |= {"success": metadata.success, **asdict(metadata), **flatten_statistics(statistics)}
        video = b"" if colors is None else encode_video(colors, fps)
        return cls(row, encode_table(make_table(columns)), video)

    @classmethod
    def from_archive(cls, content: bytes) -> "EncodedEpisode":
        """Decode an episode that `to_archive` encoded.

        Raises:
            Exception: The archive is damaged; zipfile and json raise errors of several types.
        """
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            row = json.loads(archive.read(_ROW))
            return cls(row, archive.read(_FRAMES), archive.read(_VIDEO))

    def to_archive(self) -> bytes:
        """Encode the episode as one archive with checksums; equal episodes give equal bytes."""
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            for name, content in ((_ROW, json.dumps(self.row)), (_FRAMES, self.frames), (_VIDEO, self.video)):
                archive.writestr(zipfile.ZipInfo(name), content)
        return stream.getvalue()


def read_metadata(row: Mapping[str, Any]) -> EpisodeMetadata:
    """Return scene, policies and outcome of an episode from its row.

    Raises:
        KeyError: The row is not one of this library.
    """
    return EpisodeMetadata(**{field.name: row[field.name] for field in fields(EpisodeMetadata)})


def flatten_statistics(statistics: Mapping[str, FeatureStatistics]) -> dict[str, list[Any]]:
    """Return statistics by names such as "stats/action/mean"."""
    return {
        f"{_STATISTICS_PREFIX}/{feature}/{name}": value
        for feature, values in statistics.items()
        for name, value in values.items()
    }


def read_statistics(row: Mapping[str, Any], features: Iterable[str]) -> dict[str, FeatureStatistics]:
    """Return the statistics of features in an episode's row."""
    prefixes = {feature: f"{_STATISTICS_PREFIX}/{feature}/" for feature in features}
    return {
        feature: {name.removeprefix(prefix): value for name, value in row.items() if name.startswith(prefix)}
        for feature, prefix in prefixes.items()
    }
