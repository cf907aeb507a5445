"""GA-DDPG's network is trained, stopped and gone on with, on a few synthetic scenes, and plays."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")
pytest.importorskip("matplotlib", reason="needs the extra `plot`")
pytest.importorskip("igl", reason="needs the extra `planning`")
pytest.importorskip("embreex", reason="needs the extra `vision`")

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import OptionError, ResultsError
from handover_marl.imitation.gaddpg.expert import ExpertConfig
from handover_marl.imitation.gaddpg.gaddpg_training import GaddpgArgs, GaddpgTraining, shared_scenes
from handover_marl.imitation.gaddpg.grasp_book import PriceConfig
from handover_marl.imitation.gaddpg.workshop import WorkshopConfig, workshop_of
from handover_marl.receivers import make

# Neither tried out nor planned for, which takes minutes the first time.
QUICK: dict[str, Any] = {
    "dataset": "synthetic",
    "situations": 4,
    "rounds": 2,
    "episodes": 1,
    "updates": 4,
    "batch": 4,
    "val_scenes": 1,
    "workers": 1,
    "prices": PriceConfig(tried=False),
    "expert": ExpertConfig(planned=False, candidates=3),
}


def steps_of(folder: Path) -> list[str]:
    return [row.split(",")[0] for row in (folder / "learning_curve.csv").read_text().splitlines()]


def test_a_run_is_stopped_and_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    args = {**QUICK, "out": str(tmp_path / "run")}
    # Scenes are generated as they are drawn.
    monkeypatch.setattr("handover_marl.imitation.gaddpg.gaddpg_training.shared_scenes", lambda data, setups: (11, 12))
    with monkeypatch.context() as patched:
        patched.setattr(GaddpgTraining, "_late", lambda training: training._round == 1)
        GaddpgTraining(GaddpgArgs(**args), "train_gaddpg").run()
    assert steps_of(tmp_path / "run") == ["steps", "2"]
    with pytest.raises(ResultsError, match="holds a run; pass --resume"):
        GaddpgTraining(GaddpgArgs(**args), "train_gaddpg")
    policy = GaddpgTraining(GaddpgArgs(**args, resume=True), "train_gaddpg").run()
    assert steps_of(tmp_path / "run") == ["steps", "2", "4"]
    made = make(("gaddpg", {"weights": str(policy)}), SyntheticDataset(robot="panda_camera"))
    assert made.label.startswith("gaddpg@own weights ")


def test_what_is_met_depends_on_the_seed_alone() -> None:
    data = SyntheticDataset(robot="panda_camera")
    scenes = shared_scenes(data, ("s0", "s3"))[:2]
    config = WorkshopConfig(scenes, "synthetic", prices=QUICK["prices"], expert=QUICK["expert"])
    shop = workshop_of(config)
    plans = {number: plan for number in range(3) if (plan := shop.plan(number)) is not None}
    both = shop.states(list(plans), list(plans.values()), None, 0)
    one = [shop.states([number], [plan], None, 0) for number, plan in plans.items()]
    assert sum(map(len, one)) == len(both)
    np.testing.assert_array_equal(np.sort(both.remaining), np.sort(np.concatenate([part.remaining for part in one])))
    assert set(both.remaining.tolist()) <= set(range(1, 21))
    other = shop.states(list(plans), list(plans.values()), None, 1)
    assert len(other) != len(both) or not np.array_equal(other.goals, both.goals)


def test_impossible_numbers_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="rounds=0"):
        GaddpgTraining(GaddpgArgs(**{**QUICK, "rounds": 0, "out": str(tmp_path)}), "train_gaddpg")
    with pytest.raises(OptionError, match="setups"):
        shared_scenes(SyntheticDataset(), ())
