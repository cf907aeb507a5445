"""Tests of training GA-DDPG's network on a few synthetic scenes: interruption, resuming and deployment."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")
pytest.importorskip("matplotlib", reason="needs the extra `plot`")
pytest.importorskip("igl", reason="needs the extra `planning`")
pytest.importorskip("embreex", reason="needs the extra `vision`")

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import ResultsError
from handover_marl.learning.imitation.gaddpg.data_generation import (
    DataGenerator,
    DataGeneratorConfig,
    RolloutTask,
    collect_states,
    list_shared_scenes,
    make_plans,
)
from handover_marl.learning.imitation.gaddpg.expert import GraspExpertConfig
from handover_marl.learning.imitation.learner import ImitationLearner
from handover_marl.receivers import make
from tests.learning.training.scripts import script
from tests.short_episodes import shorten_episodes

# The validation of grasps and the planner are off, because they take minutes at first use.
QUICK: dict[str, Any] = {
    "dataset": "synthetic",
    "scenarios": 4,
    "rounds": 1,
    "episodes": 1,
    "updates": 4,
    "batch_size": 4,
    "val_scenes": 1,
    "workers": 1,
    "expert": GraspExpertConfig(use_validation=False, use_planner=False, candidates=3),
}


@pytest.fixture
def train(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return script("train_gaddpg", monkeypatch)


@pytest.mark.slow
def test_interrupted_run_is_resumed(
    tmp_path: Path, train: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    args = {**QUICK, "out": str(tmp_path / "run")}
    shorten_episodes(monkeypatch, 4000)
    # Few scenes, because each one is generated when it is loaded.
    monkeypatch.setattr(train, "list_shared_scenes", lambda data, setups: (11, 12))

    update = ImitationLearner.update

    def update_twice(learner: ImitationLearner, batch: Any) -> dict[str, float]:
        if learner.done == 2:
            raise KeyboardInterrupt
        return update(learner, batch)

    with monkeypatch.context() as patched:
        patched.setattr(ImitationLearner, "update", update_twice)
        with pytest.raises(KeyboardInterrupt):
            train.main(train.Args(**args))
    assert "2 gradient updates, wait 3.0: success" in capsys.readouterr().out
    with pytest.raises(ResultsError, match="holds a run; pass --resume"):
        train.main(train.Args(**args))
    policy = train.main(train.Args(**args, resume=True))
    printed = capsys.readouterr().out
    assert "4 gradient updates, wait 3.0: success" in printed
    assert "\n2 gradient updates" not in printed
    receiver = make(("gaddpg", {"weights": str(policy)}), SyntheticDataset(robot="panda_camera"))
    assert receiver.label.startswith("gaddpg@own weights ")


def test_states_depend_on_the_seed_only() -> None:
    scenes = list_shared_scenes(SyntheticDataset(robot="panda_camera"), ("s0", "s3"))[:2]
    generator = DataGenerator(DataGeneratorConfig(scenes, "synthetic", expert=QUICK["expert"]))
    plans = {number: plan for number in range(3) if len((plan := generator.plan(number)).goals)}
    both, other = (
        generator.collect_states(RolloutTask(list(plans), list(plans.values()), repetition), None)
        for repetition in (0, 1)
    )
    single = [generator.collect_states(RolloutTask([number], [plan], 0), None) for number, plan in plans.items()]
    assert sum(len(one.remaining) for one in single) == len(both.remaining)
    np.testing.assert_array_equal(np.sort(both.remaining), np.sort(np.concatenate([one.remaining for one in single])))
    assert set(both.remaining.tolist()) <= set(range(1, 21))
    assert len(other.remaining) != len(both.remaining) or not np.array_equal(other.goals, both.goals)


@pytest.mark.slow
def test_plans_and_states_do_not_depend_on_workers(tmp_path: Path) -> None:
    scenes = list_shared_scenes(SyntheticDataset(robot="panda_camera"), ("s0", "s3"))[:1]
    config = DataGeneratorConfig(scenes, "synthetic", expert=QUICK["expert"])
    made = []
    for workers in (1, 2):
        plans = make_plans(tmp_path / f"plans {workers}", config, 2, workers)
        tasks = [RolloutTask([number], [plan], 0) for number, plan in plans.items()]
        states = collect_states(tmp_path / f"states {workers}", config, tasks, None, workers)
        made.append([*(array for plan in plans.values() for array in plan), *states])
    for first, second in zip(*made, strict=True):
        np.testing.assert_array_equal(first, second)
