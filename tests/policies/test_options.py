"""Numbers of a configuration as options of a policy."""

import re
from dataclasses import replace

import pytest

from handover_marl.errors import OptionError
from handover_marl.policies.policy import override_options
from handover_marl.receivers.reactive.config import ReactiveConfig


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("standoff", 0.1, "such as approach_standoff, got 'standoff'"),
        ("approach", 0.1, "got 'approach'"),
        ("approach_grip", 0.1, "got 'approach_grip'"),
        ("approach_standoff", "far", "approach_standoff must be a finite float, got 'far'"),
        ("approach_standoff", float("nan"), "must be a finite float, got nan"),
        ("selection_max_candidates", 2.5, "must be a finite int, got 2.5"),
    ],
)
def test_invalid_options(name: str, value: object, message: str) -> None:
    with pytest.raises(OptionError, match=re.escape(message)):
        override_options(ReactiveConfig(), {name: value}, "approach_standoff")


def test_option_of_a_section() -> None:
    config = ReactiveConfig()
    changed = override_options(config, {"preparation_max_copies": 5}, "approach_standoff")
    assert changed == replace(config, preparation=replace(config.preparation, max_copies=5))
