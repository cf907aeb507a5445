"""Tests that synthetic scenes end as recorded; `python -m tests.evaluation.golden` writes the file again."""

import json

import pytest

from tests.evaluation.golden import FILE, SCENES, outcomes, text

EXPECTED = json.loads(FILE.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("physics", SCENES)
def test_synthetic_scenes_end_as_recorded(physics: str) -> None:
    """Outcomes, steps and release steps equal the recorded ones; regenerate the file if they are meant to change."""
    found = outcomes(physics)
    changed = {
        scene: (EXPECTED[physics].get(scene), outcome)
        for scene, outcome in found.items()
        if EXPECTED[physics].get(scene) != outcome
    }
    assert not changed
    assert found == EXPECTED[physics]


def test_fast_physics_ends_as_exact_physics() -> None:
    """The status of every scene is the same in both engines, and they end at most 0.1 s apart."""
    for scene, (label, steps, _) in EXPECTED["exact"].items():
        assert EXPECTED["fast"][scene][0] == label
        assert abs(EXPECTED["fast"][scene][1] - steps) <= 100


def test_the_recorded_outcomes_vary() -> None:
    """The recorded scenes end in several ways, some of them after the person released the object."""
    assert FILE.read_text() == text(EXPECTED)
    assert {physics: (*map(int, found),) for physics, found in EXPECTED.items()} == SCENES
    for physics, least in (("fast", 3), ("exact", 2)):
        labels, steps, releases = zip(*EXPECTED[physics].values(), strict=True)
        assert len({*labels}) >= least
        assert len({*steps}) > len(steps) // 2
        assert any(release is not None for release in releases)
