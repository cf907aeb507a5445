"""Tests of the giver that chooses the best of many random offers."""

from pathlib import Path

import numpy as np
import pytest

from handover_marl import givers
from handover_marl.errors import DataFormatError, DataNotFoundError, OptionError
from handover_marl.learning.adaptive_giver import N_OFFER_FEATURES, OFFER_FEATURES
from handover_marl.learning.policy_files import DenseNetwork, PolicySpec, write_policy
from tests.givers.test_givers import seen


def write_weights(path: Path, feature: int, features: str = OFFER_FEATURES) -> str:
    """Write a network that predicts a success for offers with a large value of one feature."""
    weight = np.zeros((2, N_OFFER_FEATURES), np.float32)
    weight[0, feature] = 5.0
    network = DenseNetwork((weight,), (np.zeros(2, np.float32),))
    write_policy(path, PolicySpec("giver", features, "offer"), network)
    return str(path)


@pytest.mark.parametrize(("feature", "component", "limit"), [(43, 3, 0.25), (46, 6, 1.0)])
def test_the_giver_takes_the_offer_that_its_network_prefers(
    tmp_path: Path, feature: int, component: int, limit: float
) -> None:
    """Features 43 and 46 are the translation upwards and the rotation about the vertical."""
    weights = write_weights(tmp_path / "up.npz", feature)
    giver = givers.make(f"adaptive:weights={weights},offers=500,reach_cost=0")
    assert giver.weights_hash.startswith("up@")
    giver.reset(0)
    assert not giver.act(seen(holding=np.float32([0]))).any()
    far = giver.act(seen())
    if component == 6:
        assert far[component] > 0.8 * limit
    else:
        few = givers.make(f"adaptive:weights={weights},offers=2,reach_cost=0")
        few.reset(0)
        assert far[component] > few.act(seen())[component]
    np.testing.assert_array_equal(giver.act(seen(time=np.float32([1.1]))), far)


def test_a_large_cost_of_reaching_keeps_the_wrist_near(tmp_path: Path) -> None:
    """Feature 41 is the translation towards the gripper, away from the person."""
    weights = write_weights(tmp_path / "far.npz", 41)
    shifts = []
    for cost in (0, 50):
        giver = givers.make(f"adaptive:weights={weights},reach_cost={cost}")
        giver.reset(0)
        shifts.append(giver.act(seen())[2])
    assert shifts[0] < shifts[1] - 0.05  # the gripper is at smaller y


def test_a_single_offer_is_the_recorded_pose() -> None:
    giver = givers.make("adaptive:offers=1")
    giver.reset(3)
    np.testing.assert_allclose(giver.act(seen()), 0.0, atol=1e-6)


def test_bad_weights_and_options_are_named(tmp_path: Path) -> None:
    other = write_weights(tmp_path / "other.npz", 0, "giver")
    with pytest.raises(DataFormatError, match="features 'giver'"):
        givers.make(f"adaptive:weights={other}")
    with pytest.raises(DataNotFoundError):
        givers.make(f"adaptive:weights={tmp_path / 'none.npz'}")
    with pytest.raises(OptionError, match="offers"):
        givers.make("adaptive:offers=0")
