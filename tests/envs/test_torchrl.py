"""Tests that TorchRL accepts the environment, with and without this library's wrappers."""

import pytest

import handover_marl

torchrl_envs = pytest.importorskip("torchrl.envs", reason="needs the extra `torchrl`")
pytestmark = [pytest.mark.filterwarnings("ignore")]
OPTIONS = {"dataset": "synthetic", "physics": "fast", "control_period": 0.2, "max_cycles": 10}


@pytest.mark.parametrize("rewards", ["sparse", "shaped"])
def test_the_two_agent_environment(rewards: str) -> None:
    from torchrl.envs.utils import check_env_specs

    env = torchrl_envs.PettingZooWrapper(handover_marl.parallel_env(rewards=rewards, **OPTIONS), return_state=True)
    check_env_specs(env)
    rollout = env.rollout(20)
    # Random actions may end an episode before it is cut off.
    assert rollout.shape[0] == 10 or rollout["next", "receiver", "done"][-1].all()
    assert rollout.shape[0] <= 10
    assert ("next", "receiver", "info", "reward/task") in rollout.keys(True)
    env.close()


@pytest.mark.parametrize("frozen", [False, True])
def test_wrapped_environments(frozen: bool) -> None:
    from torchrl.envs.utils import check_env_specs

    world = handover_marl.parallel_env(**OPTIONS)
    env = torchrl_envs.PettingZooWrapper(handover_marl.encode(handover_marl.freeze(world) if frozen else world))
    check_env_specs(env)
    assert sorted(env.group_map) == (["receiver"] if frozen else ["giver", "receiver"])
    env.close()
