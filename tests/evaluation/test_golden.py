"""Tests that synthetic scenes end as recorded; `python -m tests.evaluation.golden` writes the file again."""

import json

import pytest

from tests.evaluation.golden import FILE, SCENES, outcomes

EXPECTED = json.loads(FILE.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("physics", SCENES)
def test_synthetic_scenes_end_as_recorded(physics: str) -> None:
    """Outcomes, steps and release steps equal the recorded ones; regenerate the file if they are meant to change."""
    assert outcomes(physics) == EXPECTED[physics]


def test_fast_physics_ends_as_exact_physics() -> None:
    """The status of every scene is the same in both engines, and they end at most 0.1 s apart."""
    for scene, (label, steps, _) in EXPECTED["exact"].items():
        assert EXPECTED["fast"][scene][0] == label
        assert abs(EXPECTED["fast"][scene][1] - steps) <= 100
