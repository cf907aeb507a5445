import pickle
from typing import Any

import numpy as np
import pytest

from handover_marl.errors import UnknownArgumentError, UnknownNameError, check_name


@pytest.mark.parametrize("name", [None, 5, ["s0"], {"s0"}, b"s0", np.array(["s0"]), np.zeros(2), "", "s", object()])
def test_other_values_than_the_names_do_not_exist(name: Any) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown setup .*; valid: s0, s1"):
        check_name("setup", name, ("s0", "s1"))


def test_names_and_numbers_exist() -> None:
    check_name("setup", "s0", ("s0", "s1"))
    check_name("subject", np.int64(3), range(1, 11))
    with pytest.raises(UnknownNameError, match="unknown subject 0; valid: 1, 2"):
        check_name("subject", 0, range(1, 3))


def test_errors_keep_their_message_in_other_processes() -> None:
    for error in (
        UnknownArgumentError("benchmark", "scene", ("scenes", "setup")),
        UnknownNameError("split", "tests", ("train", "val", "test"), "see the documentation"),
    ):
        assert str(pickle.loads(pickle.dumps(error))) == str(error)
        assert "; did you mean " in str(error)
