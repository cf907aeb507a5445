"""Nodes with other versions of what results depend on are refused by name."""

import pytest

from handover_marl.errors import WorkerError
from handover_marl.pools.ray_pool import Hello, check_versions, versions


def hello(**changes: str) -> Hello:
    return Hello("0", "far", {**versions(), **changes})


def test_the_same_are_welcome() -> None:
    check_versions(hello())


@pytest.mark.parametrize("name", ["handover_marl", "numpy", "scipy", "pybullet"])
@pytest.mark.parametrize("there", ["0.0.1", "none"])
def test_others_are_refused(name: str, there: str) -> None:
    with pytest.raises(WorkerError, match=f"node far has other versions \\({name} {there} there, .* here\\)"):
        check_versions(hello(**{name: there}))


def test_mujoco_may_be_missing_but_not_differ() -> None:
    check_versions(hello(mujoco="none"))
    if versions()["mujoco"] == "none":
        pytest.skip("needs the extra `mujoco`")
    with pytest.raises(WorkerError, match=r"mujoco 3\.9\.0 there"):
        check_versions(hello(mujoco="3.9.0"))
