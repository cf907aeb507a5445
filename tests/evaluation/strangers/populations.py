"""Functions that write population files for tests."""

import json
from pathlib import Path
from typing import Any

GIVERS = [
    {
        "name": "recorded",
        "family": "plain",
        "split": "train",
        "policy": "replay",
        "description": "Replays the recording.",
    },
    {
        "name": "fast",
        "family": "timing",
        "split": "test",
        "policy": "hurried:min_rate=0.5,max_rate=0.6",
        "description": "Replays the recording faster.",
    },
    {
        "name": "slow",
        "family": "timing",
        "split": "test",
        "policy": "hurried:min_rate=-0.6,max_rate=-0.5",
        "description": "Replays the recording slower.",
    },
]
RECEIVERS = [
    {"name": "still", "family": "still", "split": "test", "policy": "hold", "description": "Holds still."},
]


def make_content(**changes: Any) -> dict[str, Any]:
    content = {
        "name": "small",
        "version": "1.0",
        "description": "Population for tests.",
        "givers": [dict(each) for each in GIVERS],
        "receivers": [dict(each) for each in RECEIVERS],
    }
    return content | changes


def write_population(folder: Path, **changes: Any) -> Path:
    path = folder / "small.json"
    path.write_text(json.dumps(make_content(**changes)))
    return path
