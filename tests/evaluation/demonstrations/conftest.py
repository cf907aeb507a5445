"""Fixtures for the tests of recordings."""

from pathlib import Path

import pytest

from tests.evaluation.demonstrations.recording import OPTIONS, record


@pytest.fixture(scope="package")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a recording of two workers with point clouds and giver actions; do not write to it."""
    folder = tmp_path_factory.mktemp("demonstrations") / "out"
    record(folder, workers=2, **OPTIONS)
    return folder
