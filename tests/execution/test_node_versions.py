"""Tests of the versions of packages on nodes: nodes with versions that could change results are refused."""

import pytest

from handover_marl.errors import WorkerError
from handover_marl.execution.pool import check_versions, get_installed_versions


def test_equal_versions() -> None:
    check_versions(get_installed_versions(), get_installed_versions())


@pytest.mark.parametrize("name", ["handover_marl", "numpy", "scipy", "pybullet"])
@pytest.mark.parametrize("there", ["0.0.1", "none"])
def test_other_versions(name: str, there: str) -> None:
    with pytest.raises(WorkerError, match=f"node .* has other versions \\({name} {there} there, .* here\\)"):
        check_versions(get_installed_versions(), {**get_installed_versions(), name: there})


def test_mujoco_may_be_missing_but_not_differ() -> None:
    check_versions(get_installed_versions(), {**get_installed_versions(), "mujoco": "none"})
    if get_installed_versions()["mujoco"] == "none":
        pytest.skip("needs MuJoCo")
    with pytest.raises(WorkerError, match=r"mujoco 3\.9\.0 there"):
        check_versions(get_installed_versions(), {**get_installed_versions(), "mujoco": "3.9.0"})
