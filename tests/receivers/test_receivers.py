"""Tests of names and options of receivers, and of a batch of `yang2021`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl import givers, receivers
from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.errors import DataNotFoundError, OptionError, UnknownNameError
from handover_marl.geometry.arrays import NUMPY_ARRAYS
from handover_marl.policies.batch import ArrayPolicyBatch
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.yang2021 import Yang2021Receiver, YangPhase


def test_unknown_names(fake_data: Path) -> None:
    known = (
        "dagger, gaddpg, hold, learned, omg, omg_hand_aware, omg_unchecked_last, population, random, reactive, "
        "vision, yang2021"
    )
    for name, advice in (("nobody", ""), ("yang2012", r"; did you mean 'yang2021'\?")):
        with pytest.raises(UnknownNameError, match=f"receiver '{name}'; valid: {known}{advice}$"):
            receivers.make(name, OfficialDataset(fake_data))
    with pytest.raises(OptionError, match="giver must be a name, a class or an instance of a policy, got 3"):
        givers.make(3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("yang2021:speed=1", "unknown option 'speed'"),
        ("yang2021:step_length=0", "step_length of YangConfig must be"),
        ("yang2021:context=3", "has no option 'context'"),
        ("reactive:min_lift=-1", "min_lift of ReactiveConfig must be a finite number of at least 0, got -1"),
        ("reactive:selection_max_candidates=0", "max_candidates of GraspSelectorConfig must be an integer of at least"),
    ],
)
def test_wrong_settings(name: str, message: str) -> None:
    with pytest.raises((OptionError, UnknownNameError), match=message):
        receivers.make(name, SyntheticDataset())


@pytest.mark.parametrize(("options", "period"), [("", 0.001), (":close_decision_period=0.1", 0.1)])
def test_time_between_decisions_while_the_fingers_close(options: str, period: float) -> None:
    robot = receivers.make(f"yang2021{options}", SyntheticDataset())
    assert isinstance(robot, Yang2021Receiver)
    robot.phase[0] = YangPhase.CLOSE
    assert robot.hold_time == period


def test_a_batch_with_an_object_without_grasps() -> None:
    """The robot of a row whose object has no grasps stays where it is, and those of the other rows move."""
    data, episode = SyntheticDataset(), Episode("mujoco")
    scene = data.load_scene(14)
    episode.reset(scene)
    state = episode.observe()
    episode.close()
    missing = data.object_names[int(state["object_classes"][0]) + 1]
    context = replace(
        make_policy_context(data), load_grasps=lambda name: None if name == missing else data.load_grasps(name)
    )
    batch = ArrayPolicyBatch(Yang2021Receiver(context, wait=0.0).copy_for(3, NUMPY_ARRAYS), 3, "receiver")
    found = {key: np.stack([values] * 3) for key, values in state.items()}
    found["object_classes"][1, 0] += 1
    for row in range(3):
        batch.reset(row, None, scene.info.object_names)
    actions, _ = batch.act(
        np.arange(3), lambda rows: {key: values[rows] for key, values in found.items()}, np.zeros(3, int)
    )
    np.testing.assert_array_equal(actions[1, :7], state["robot_joint_position"][:7])
    np.testing.assert_array_equal(actions[0], actions[2])
    assert np.abs(actions[0, :7] - state["robot_joint_position"][:7]).max() > 0.1


def test_the_shipped_network_acts_as_its_file() -> None:
    data, episode = SyntheticDataset(), Episode("fast")
    path = Path(receivers.__file__).parent / "policies" / "dagger.npz"
    shipped, file = (receivers.make(f"dagger{options}", data) for options in ("", f":weights={path}"))
    assert (shipped.label, shipped.weights_hash) == ("dagger", file.weights_hash)
    episode.reset(data.load_scene(14))
    for robot in (shipped, file):
        robot.reset(0)
    np.testing.assert_array_equal(shipped.act(episode.observe()), file.act(episode.observe()))
    episode.close()
    with pytest.raises(DataNotFoundError, match=r"none\.npz"):
        receivers.make("dagger:weights=none.npz", data)
