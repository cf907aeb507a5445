from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import numpy as np
import pytest

from handover_marl import givers, receivers
from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.policies import registry
from handover_marl.receivers import WAITING_JOINTS


def test_unknown_names(fake_data: Path) -> None:
    known = (
        "gaddpg, hold, learned, omg, omg_hand_aware, omg_unchecked_last, population, random, reactive, vision, yang2021"
    )
    for name, advice in (("nobody", ""), ("yang2012", r"; did you mean 'yang2021'\?")):
        with pytest.raises(UnknownNameError, match=f"receiver '{name}'; valid: {known}{advice}$"):
            receivers.make(name, OfficialDataset(fake_data))
    with pytest.raises(OptionError, match="giver must be a name, a class or an instance of a policy, got 3"):
        givers.make(3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("no_such_module:Thing", "cannot be imported"),
        ("handover_marl.receivers.baselines:Nothing", "cannot be imported"),
        ("pathlib:Path", "must be a subclass"),
    ],
)
def test_entry_points_that_lead_nowhere(monkeypatch: pytest.MonkeyPatch, value: str, message: str) -> None:
    point = EntryPoint("mine", value, registry.GROUPS["receiver"])
    monkeypatch.setattr(registry, "entry_points", EntryPoints([point]).select)
    assert receivers.list_available() == ("mine",)
    with pytest.raises(OptionError, match=f"'mine'.*{message}"):
        receivers.make("mine", SyntheticDataset())


def test_yang_waits_then_goes_to_the_standoff_of_a_grasp(fake_data: Path) -> None:
    dataset, actions = OfficialDataset(fake_data), []
    policy, episode = receivers.make("yang2021", dataset), Episode("exact")
    episode.reset(dataset.load_scene(9))
    policy.reset()
    while episode.steps < 3001 and not episode.status:
        actions.append(policy.act(episode.observe()))
        episode.advance(actions[-1], round(policy.hold_time * 1000))
    np.testing.assert_array_equal(actions[0], np.float32(WAITING_JOINTS))
    assert all(action.shape == (9,) and action.dtype == np.float32 for action in actions)
    target = episode.observe()["object_poses"][0, :3]
    episode.world._loaded_workcell.panda.reset_joints(actions[-1].tolist())
    # All grasps come from the robot's side, 0.1 m before the object; standoffs are 0.2 m farther.
    np.testing.assert_allclose(episode.observe()["gripper_pose"][:3], target - [0.0, 0.3, 0.0], atol=2e-3)
    np.testing.assert_allclose(actions[-1][7:], 0.04, rtol=1e-6)
    assert policy.hold_time == 0.1
    assert policy.planned_goal is not None
    np.testing.assert_allclose(policy.planned_goal[:, :3], target - [[0.0, 0.3, 0.0], [0.0, 0.1, 0.0]], atol=2e-3)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("yang2021:speed=1", "YangConfig such as step_length, got 'speed'"),
        ("yang2021:step_length=0", "step_length of YangConfig must be"),
        ("yang2021:config=3", "config must be a YangConfig, got 3"),
        ("yang2021:context=3", "has no option 'context'"),
        ("reactive:config=3", "config must be a ReactiveConfig, got 3"),
        ("reactive:min_lift=-1", "min_lift of ReactiveConfig must be a finite number of at least 0, got -1"),
        ("reactive:selection_max_candidates=0", "max_candidates of GraspSelectorConfig must be an integer of at least"),
        ("reactive:servo_speed_scale=0", "speed_scale of ServoConfig must be a finite number from 1e-06 to 1, got 0"),
    ],
)
def test_wrong_settings(name: str, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        receivers.make(name, SyntheticDataset())
