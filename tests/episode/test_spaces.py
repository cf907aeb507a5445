import numpy as np
import pytest

from handover_marl.config import GiverConfig
from handover_marl.episode.spaces import (
    check_giver_action,
    check_receiver_action,
    giver_action_space,
)
from handover_marl.errors import ActionError


class Tensor:
    """Object that cannot be converted to an array, like a torch tensor with a gradient."""

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        raise RuntimeError("Can't call numpy() on Tensor that requires grad")


@pytest.mark.parametrize(
    "action",
    [
        [0.1] * 9,
        np.full(9, 0.1),
        np.ones(9, dtype=bool),
        np.arange(9),
    ],
)
def test_real_numbers_are_rounded_to_float32(action: object) -> None:
    checked = check_receiver_action(action)
    assert checked.dtype == np.float32
    np.testing.assert_array_equal(checked, np.asarray(action).astype(np.float32))


@pytest.mark.parametrize(
    "action",
    [
        ["0.1"] * 9,
        [None] + [0.0] * 8,
        np.zeros(9, dtype=complex),
        [10**400] * 9,
        [[0.0], [0.0, 1.0]],
        np.zeros(9, dtype="datetime64[s]"),
        Tensor(),
    ],
)
def test_what_is_no_number_is_refused(action: object) -> None:
    with pytest.raises(ActionError, match=r"action of the receiver must be 9 numbers, .*, got "):
        check_receiver_action(action)


def test_what_givers_may_do_can_be_chosen() -> None:
    space = giver_action_space(GiverConfig(displacement=0.1, rotation=0.5))
    np.testing.assert_array_equal(space.high, np.float32([1, 0.1, 0.1, 0.1, 0.5, 0.5, 0.5, 1]))
    np.testing.assert_array_equal(check_giver_action(np.full(8, 9.0), space), space.high)
    np.testing.assert_array_equal(check_giver_action(np.full(8, -9.0), space), space.low)


def test_tensors_on_a_gpu_are_explained() -> None:
    class GpuTensor(Tensor):
        """Tensor that has the method `detach`."""

        def detach(self) -> None: ...

    with pytest.raises(ActionError, match=r"got GpuTensor with a gradient or on a GPU; pass tensor\.detach"):
        check_receiver_action(GpuTensor())
    with pytest.raises(ActionError, match=r"got Tensor$"):
        check_receiver_action(Tensor())
