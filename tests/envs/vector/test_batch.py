"""Tests of vector environments of tensors: they return on a device what NumPy's return on the processor."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from handover_marl.envs.vector.batch import EnvBatch, EnvResult, check_action_array
from handover_marl.envs.vector.parallel_vector_env import ParallelVectorEnv
from handover_marl.envs.vector.vector_env import HandoverVectorEnv
from handover_marl.errors import ActionError
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ArrayFactory, make_tensor_factory
from tests.envs.vector.comparison import assert_same
from tests.helpers.fake_device import DeviceTensor, FakeDevice, torch

COUNT = 5
ACTIONS = spaces.Box(-np.ones(2, np.float32), np.ones(2, np.float32))


@pytest.fixture(autouse=True)
def device() -> Iterator[None]:
    with FakeDevice():
        yield


class CountingEnvs:
    """Environments that add up actions; the episodes of environment k have k + 2 steps, with even k they terminate."""

    def __init__(self, agents: Sequence[str], arrays: ArrayFactory, count: int) -> None:
        self.arrays, self._agents = arrays, agents
        self._steps, self._episodes = (arrays.zeros(count, "int64") for _ in range(2))
        self._sums = {agent: arrays.zeros((count, 2), "float32") for agent in agents}

    def reset(self, rows: np.ndarray, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        own = self.arrays.asarray(rows)
        self._steps[own] = 0
        self._episodes[own] += 1
        for sums in self._sums.values():
            sums[own] = 0.0
        return self._make_result(rows)

    def check_actions(self, actions: dict[str, Any]) -> dict[str, Any]:
        return {agent: self.arrays.asarray(values, "float32") for agent, values in actions.items()}

    def step(self, rows: np.ndarray, actions: dict[str, Any]) -> EnvResult:
        own = self.arrays.asarray(rows)
        self._steps[own] += 1
        for agent, values in actions.items():
            self._sums[agent][own] += values
        return self._make_result(rows)

    def render(self) -> None:
        """Return nothing."""

    def close(self) -> None:
        """Do nothing."""

    def _make_result(self, rows: np.ndarray) -> EnvResult:
        own = self.arrays.asarray(rows)
        steps, last = self._steps[own], own + 2
        ended, reward = steps == last, 1.5 * self.arrays.xp.astype(steps, self.arrays.xp.float64)
        infos = {"steps": steps, "episode": self._episodes[own], "reward/steps": reward}
        parts = {
            agent: ({"sum": sums[own], "time": steps[:, None]}, reward, ended & (own % 2 == 0), ended, infos)
            for agent, sums in self._sums.items()
        }
        return EnvResult(*({agent: part[k] for agent, part in parts.items()} for k in range(5)))


def make_env(agents: Sequence[str], autoreset: str, arrays: ArrayFactory) -> HandoverVectorEnv | ParallelVectorEnv:
    envs, action_spaces = CountingEnvs(agents, arrays, COUNT), dict.fromkeys(agents, ACTIONS)
    batch = EnvBatch(envs, action_spaces, COUNT, AutoresetMode[autoreset.upper()])
    template: Any = SimpleNamespace(
        possible_agents=list(agents),
        observation_space=lambda agent: spaces.Dict({"sum": ACTIONS, "time": ACTIONS}),
        action_space=lambda agent: ACTIONS,
        metadata={},
        scene_ids=(),
        render_mode=None,
    )
    template.unwrapped = template
    return HandoverVectorEnv(batch, template) if len(agents) == 1 else ParallelVectorEnv(batch, template)


def rollout(agents: Sequence[str], autoreset: str, arrays: ArrayFactory) -> list[Any]:
    """Return the results of resets, with and without a mask, and of steps."""
    envs, rng = make_env(agents, autoreset, arrays), np.random.default_rng(0)
    mask = np.array([True, False, False, True, False])
    found: list[Any] = [envs.reset(seed=1)]
    for arguments in ({"options": {"reset_mask": arrays.asarray(mask)}}, {}):
        for number in range(9):
            values = {agent: arrays.asarray(rng.normal(size=(COUNT, 2)), "float32") for agent in agents}
            found.append(envs.step(values if len(agents) == 2 else values[agents[0]]))
            if autoreset == "disabled" and number % 2:
                found.append(envs.reset())
        found.append(envs.reset(**arguments))
    envs.close()
    return found


@pytest.mark.parametrize("autoreset", ["next_step", "same_step", "disabled"])
@pytest.mark.parametrize("agents", [("receiver",), ("giver", "receiver")], ids=len)
def test_results_are_those_of_arrays(agents: Sequence[str], autoreset: str) -> None:
    expected = rollout(agents, autoreset, NUMPY_ARRAYS)
    assert_same(rollout(agents, autoreset, make_tensor_factory("cuda")), expected)


def test_last_observations_and_infos_of_episodes() -> None:
    envs = make_env(["receiver"], "same_step", make_tensor_factory("cuda"))
    envs.reset()
    actions = make_tensor_factory("cuda").full((COUNT, 2), 1.0, "float32")
    envs.step(actions)
    observations, _, terminations, truncations, infos = envs.step(actions)
    assert terminations.tolist() == truncations.tolist() == [True, False, False, False, False]
    assert observations["time"].tolist() == [[0], [2], [2], [2], [2]]
    assert infos["_final_obs"].tolist() == [True, False, False, False, False]
    last = infos["final_obs"][infos["_final_obs"]]
    assert [one["time"].tolist() for one in last] == [[2]]
    assert isinstance(last[0]["sum"], DeviceTensor)
    assert infos["final_info"]["steps"].tolist() == [2, 0, 0, 0, 0]
    assert infos["_final_info"].tolist() == infos["final_info"]["_steps"].tolist() == [True, *[False] * 4]


Make = Callable[[], Any]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: torch.zeros(COUNT, 3), r"must have shape \(5, 2\), got torch.float32 \(5, 3\)"),
        (lambda: torch.zeros(COUNT * 2), r"must have shape \(5, 2\), got torch.float32 \(10,\)"),
        (lambda: torch.zeros(COUNT, 2, dtype=torch.bool), r"must have shape \(5, 2\), got torch.bool \(5, 2\)"),
        (lambda: torch.zeros(COUNT, 2, dtype=torch.complex64), "got torch.complex64"),
        (lambda: torch.zeros(COUNT, 2, requires_grad=True), "grad"),
    ],
)
@pytest.mark.parametrize("arrays", [NUMPY_ARRAYS, make_tensor_factory("cuda")], ids=["array", "tensor"])
def test_wrong_tensors_are_refused(make: Make, message: str, arrays: ArrayFactory) -> None:
    error = message.replace("torch.", "") if arrays is NUMPY_ARRAYS else message
    with pytest.raises(ActionError, match=error):
        check_action_array(make(), ACTIONS, COUNT, "receiver", arrays)


def test_tensors_on_a_device_are_refused_without_a_simulation_there() -> None:
    with pytest.raises(ActionError, match="must be an array"):
        check_action_array(torch.zeros(COUNT, 2, device="cuda"), ACTIONS, COUNT, "receiver")
    actions = torch.zeros(COUNT, 2)
    values = check_action_array(actions, ACTIONS, COUNT, "receiver")
    assert type(values) is np.ndarray
    values[0, 0] = 1.0
    assert actions[0, 0] == 1.0, "memory is shared"
