"""Tests that synthetic scenes end as recorded; `python -m tests.evaluation.golden` writes the file again."""

import json

import pytest

from tests.evaluation.golden import EXACT, FILE, N_FAST, outcomes, text

EXPECTED = json.loads(FILE.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["fast", "exact"])
def test_synthetic_scenes_end_as_recorded(physics: str) -> None:
    """Outcomes, steps and release steps equal the recorded ones; regenerate the file if they are meant to change."""
    # Every other scene, which takes half the time.
    chosen = list(EXPECTED[physics])[physics == "fast" :: 2]
    found = outcomes(physics, [*map(int, chosen)])
    assert found == {scene: EXPECTED[physics][scene] for scene in chosen}


def test_the_recorded_outcomes_vary() -> None:
    """The scenes end in several ways, some after the person released the object, and alike in both engines."""
    assert FILE.read_text() == text(EXPECTED)
    assert (len(EXPECTED["fast"]), len(EXPECTED["exact"])) == (N_FAST, len(EXACT))
    labels, steps, releases = zip(*EXPECTED["fast"].values(), strict=True)
    assert len({*labels}) >= 3
    assert len({*steps}) > len(steps) // 2
    assert any(release is not None for release in releases)
    for scene, (label, exact_steps, _) in EXPECTED["exact"].items():
        assert EXPECTED["fast"][scene][0] == label
        assert abs(EXPECTED["fast"][scene][1] - exact_steps) <= 100
