"""Tests that TorchRL accepts the environment, with and without this library's wrappers."""

import numpy as np
import pytest

import handover_marl

torch = pytest.importorskip("torch", reason="needs the extra `train`")
torchrl_envs = pytest.importorskip("torchrl.envs", reason="needs the extra `torchrl`")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
OPTIONS = {"dataset": "synthetic", "physics": "fast", "control_period": 0.2, "max_cycles": 10}


def test_the_two_agent_environment() -> None:
    from torchrl.envs.utils import check_env_specs

    env = torchrl_envs.PettingZooWrapper(handover_marl.parallel_env(rewards="shaped", **OPTIONS), return_state=True)
    check_env_specs(env)
    rollout = env.rollout(20)
    # Random actions may end an episode before it is cut off.
    assert rollout.shape[0] == 10 or rollout["next", "receiver", "done"][-1].all()
    assert rollout.shape[0] <= 10
    assert ("next", "receiver", "info", "reward/success") in rollout.keys(True)
    env.close()


@pytest.mark.parametrize("frozen", [False, True])
def test_wrapped_environments(frozen: bool) -> None:
    from torchrl.envs.utils import check_env_specs

    world = handover_marl.parallel_env(**OPTIONS)
    env = torchrl_envs.PettingZooWrapper(handover_marl.encode(handover_marl.control_agent(world) if frozen else world))
    check_env_specs(env)
    assert sorted(env.group_map) == (["receiver"] if frozen else ["giver", "receiver"])
    env.close()


@pytest.mark.parametrize(("autoreset", "encoded"), [("disabled", False), ("same_step", True)])
def test_vector_environments(autoreset: str, encoded: bool) -> None:
    from torchrl.envs.utils import check_env_specs

    encoding = {"features": "receiver", "action_scheme": "cartesian_delta"} if encoded else {}
    options = {**OPTIONS, **encoding, "physics": "mujoco", "max_cycles": 3, "threads": 1}
    env = torchrl_envs.GymWrapper(handover_marl.vector_env(2, "receiver", "replay", autoreset=autoreset, **options))
    check_env_specs(env)
    # Some random actions end an episode early.
    torch.manual_seed(0)
    rollout = env.rollout(8, break_when_any_done=False)
    assert rollout.shape == (2, 8)
    assert (rollout["next", "done"][:, [2, 5], 0]).all()
    assert rollout["next", "done"].sum() == 4
    # In the mode `same_step`, TorchRL finds the last observations of an episode only if they are one array.
    if autoreset == "disabled":
        # The last observations of an episode are its own, and the next episode starts anew.
        for times, expected in ((rollout["time"], [0.0, 0.2, 0.4]), (rollout["next", "time"], [0.2, 0.4, 0.6])):
            np.testing.assert_allclose(times[0, :6, 0], expected * 2, atol=1e-6)
    env.close()
