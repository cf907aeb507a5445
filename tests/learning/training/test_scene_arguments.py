"""Tests of the arguments that scripts share."""

import pytest

from handover_marl.errors import UnknownNameError
from handover_marl.learning.training.scene_arguments import SetupArgs

GENERATED = "generated:n=50,seed=7"


@pytest.mark.parametrize(
    ("dataset", "setup", "expected"),
    [
        *(("synthetic", None, "s0"), ("synthetic", "s2", "s2")),
        *((GENERATED, None, "random"), (GENERATED, "random", "random")),
    ],
)
def test_setup_is_the_first_of_the_dataset(dataset: str, setup: str | None, expected: str) -> None:
    assert SetupArgs(dataset=dataset, setup=setup).resolve_setup().setup == expected


def test_unknown_setups_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="s0"):
        SetupArgs(dataset=GENERATED, setup="s0").resolve_setup()


def test_runs_without_a_setup_use_the_first() -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
    pytest.importorskip("mujoco", reason="the default physics")
    from handover_marl.learning.training.stable_baselines import PpoArgs

    config = PpoArgs(dataset=GENERATED).make_env_config()
    assert config.setup is None
    assert len(config.scenes or ()) > 30
