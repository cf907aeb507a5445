from dataclasses import replace

import pytest

from handover_marl.datasets.generated.config import FAMILY_DEFAULTS, GeneratedConfig, parse_generated_config
from handover_marl.errors import HandoverError


def test_family_sets_its_defaults() -> None:
    hard = parse_generated_config("n=5,family=hard")
    assert hard == replace(FAMILY_DEFAULTS["hard"], n=5)
    assert parse_generated_config("clutter_max=1") == GeneratedConfig(clutter_min=1, clutter_max=1)
    for family, usual in FAMILY_DEFAULTS.items():
        config = replace(usual, n=17, seed=2**32 - 1, left=0.1 + 0.2, boxes=1e-5)
        assert config.family == family
        assert parse_generated_config(config.argument) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must be described as n=1000,seed=7, got ''"),
        ("n=ten", "n must be a whole number, got 'ten'"),
        ("n=0", "n must be from 1 to"),
        ("n=1,n=2", "parameter n .* must be given once"),
        ("left=nan", "left must be from 0 to 1, got nan"),
        ("clutter_min=3,clutter_max=2", "clutter_min must be from 0 to 2, got 3"),
        ("boxes=0,cylinders=0,bottles=0,tools=0,superquadrics=0", "must be above 0, got 0 for all"),
        ("sed=1", "unknown parameter of generated scenes 'sed'"),
        ("family=easy", "unknown family 'easy'"),
    ],
)
def test_wrong_texts_are_refused(text: str, message: str) -> None:
    with pytest.raises(HandoverError, match=message):
        parse_generated_config(text)
