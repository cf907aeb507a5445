"""Functions that write population files for tests."""

import json
from pathlib import Path
from typing import Any


def describe(name: str, family: str, split: str, policy: str) -> dict[str, str]:
    return {"name": name, "family": family, "split": split, "policy": policy, "description": f"Partner {name}."}


GIVERS = [
    describe("recorded", "plain", "train", "replay"),
    describe("fast", "timing", "test", "hurried:min_rate=0.5,max_rate=0.6"),
    describe("slow", "timing", "test", "hurried:min_rate=-0.6,max_rate=-0.5"),
]
RECEIVERS = [describe("still", "still", "test", "hold")]


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
