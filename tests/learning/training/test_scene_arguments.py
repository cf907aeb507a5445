"""Tests of the arguments that scripts share."""

import json
from pathlib import Path

import pytest

from handover_marl.errors import UnknownNameError
from handover_marl.learning.training.arguments import PpoArgs
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


def test_training_runs_record_the_setup(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
    from handover_marl.learning.training.training_run import TrainingRun

    args = PpoArgs(dataset=GENERATED, out=str(tmp_path / "run"), val_scenes=2)
    TrainingRun(args, "train_giver_sb3", {"giver": ("giver", "offer")}, {"receiver": "hold"})
    assert json.loads((tmp_path / "run" / "arguments.json").read_text())["setup"] == "random"
    assert args.make_env_config().setup is None
    assert len(args.make_env_config().scenes or ()) > 30
