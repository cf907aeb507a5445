"""Tests of training GA-DDPG's network on a few synthetic scenes: interruption, resuming and deployment."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")
pytest.importorskip("matplotlib", reason="needs the extra `plot`")
pytest.importorskip("igl", reason="needs the extra `planning`")
pytest.importorskip("embreex", reason="needs the extra `vision`")

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import OptionError
from handover_marl.learning.imitation.gaddpg.data_generation import DataGenerator, list_shared_scenes
from handover_marl.learning.imitation.run import ImitationLearner
from handover_marl.learning.training.run_folder import CHECKPOINT, read_checkpoint, write_checkpoint
from handover_marl.receivers import make
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import evaluate_hold, script
from tests.receivers.quick import short_planning  # noqa: F401

pytestmark = pytest.mark.slow

# Few scenes, because each one is generated when it is loaded.
SCENES = (11, 12)


def test_interrupted_run_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    train = script("train_gaddpg", monkeypatch)
    small = {"dataset": "synthetic", "scenarios": 3, "rounds": 1, "episodes": 1, "updates": 2, "batch_size": 2}
    args = {**small, "val_scenes": 1, "workers": 1, "out": str(tmp_path / "run")}
    shorten_episodes(monkeypatch, 500)
    evaluated = evaluate_hold(monkeypatch)
    monkeypatch.setattr(train, "list_shared_scenes", lambda data, setups: SCENES)
    monkeypatch.setattr("handover_marl.learning.imitation.gaddpg.training._N_HELD_OUT", 4)
    update = ImitationLearner.update

    def update_once(learner: ImitationLearner, batch: Any) -> dict[str, float]:
        if learner.n_updates == 1:
            raise KeyboardInterrupt
        return update(learner, batch)

    with monkeypatch.context() as patched:
        patched.setattr(ImitationLearner, "update", update_once)
        with pytest.raises(KeyboardInterrupt):
            train.main(train.Args(**args))
    assert "1 gradient updates, wait 3.0: success" in capsys.readouterr().out
    policy = train.main(train.Args(**args, resume=True))
    printed = capsys.readouterr().out
    assert "2 gradient updates, wait 3.0: success" in printed
    assert "\n1 gradient updates" not in printed
    assert evaluated == ["latest.npz"] * 2
    # A run may be stopped between its last update and the evaluation.
    checkpoint = policy.parent / CHECKPOINT
    read_checkpoint(checkpoint, lambda state: write_checkpoint(checkpoint, state | {"evaluated": 1, "best": -1.0}))
    policy.unlink()
    assert train.main(train.Args(**args, resume=True)).exists()
    receiver = make(("gaddpg", {"weights": str(policy)}), SyntheticDataset(robot="panda_camera"))
    assert receiver.label.startswith("gaddpg@own weights ")


def test_states_depend_on_the_seed_only() -> None:
    data = SyntheticDataset(robot="panda_camera")
    generator, other = (DataGenerator(data, SCENES[:1], 0) for _ in range(2))
    plans = {number: plan for number in range(3) if len((plan := generator.plan(number)).goals)}
    found = {number: generator.collect_states(number, plan, 0, None) for number, plan in plans.items()}
    assert len(found) > 1
    for number, plan in reversed(plans.items()):
        for part, same in zip(found[number], other.collect_states(number, plan, 0, None), strict=True):
            np.testing.assert_array_equal(part, same)
        assert set(found[number].remaining.tolist()) <= set(range(1, 21))
        again = other.collect_states(number, plan, 1, None)
        assert len(again.goals) != len(found[number].goals) or not np.array_equal(again.goals, found[number].goals)


def test_shared_scenes_are_in_all_training_splits(monkeypatch: pytest.MonkeyPatch) -> None:
    data, listed = SyntheticDataset(robot="panda_camera"), SyntheticDataset.list_scenes
    monkeypatch.setattr(SyntheticDataset, "list_scenes", lambda *split: [one for one in listed(*split) if one < 50])
    found = list_shared_scenes(data, ("s0", "s3"))
    assert found
    assert set(found) <= set(data.list_scenes("s0", "train")) & set(data.list_scenes("s3", "train"))
    with pytest.raises(OptionError, match="setups must share training scenes"):
        list_shared_scenes(data, ())
