from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.datasets.generated.config import FAMILY_DEFAULTS, GeneratedConfig, parse_generated_config
from handover_marl.errors import OptionError, UnknownNameError


def test_family_sets_its_defaults() -> None:
    hard = parse_generated_config("n=5,family=hard")
    assert hard == replace(FAMILY_DEFAULTS["hard"], n=5)
    assert (hard.procedural, hard.clutter_min, hard.clutter_max) == (1.0, 4, 4)
    assert parse_generated_config("clutter_max=1") == GeneratedConfig(clutter_min=1, clutter_max=1)


@given(
    n=st.integers(1, 10**7),
    seed=st.integers(0, 2**32 - 1),
    family=st.sampled_from(["default", "hard"]),
    left=st.floats(0.0, 1.0),
    boxes=st.floats(0.0, 1e6),
)
def test_argument_describes_the_configuration(n: int, seed: int, family: str, left: float, boxes: float) -> None:
    config = replace(FAMILY_DEFAULTS[family], n=n, seed=seed, left=left, boxes=boxes)
    assert parse_generated_config(config.argument) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must be described as n=1000,seed=7, got ''"),
        ("n=ten", "n must be a whole number, got 'ten'"),
        ("n=0", "n must be from 1 to"),
        ("n=1,n=2", "parameter n .* must be given once"),
        ("left=nan", "left must be from 0 to 1, got nan"),
        ("clutter_max=5", "clutter_max must be from 0 to 4, got 5"),
        ("clutter_min=3,clutter_max=2", "clutter_min must be from 0 to 2, got 3"),
        ("boxes=0,cylinders=0,bottles=0,tools=0,superquadrics=0", "must be above 0, got 0 for all"),
    ],
)
def test_wrong_texts_are_refused(text: str, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        parse_generated_config(text)


@pytest.mark.parametrize("text", ["sed=1", "family=easy"])
def test_unknown_names_are_refused(text: str) -> None:
    with pytest.raises(UnknownNameError):
        parse_generated_config(text)
