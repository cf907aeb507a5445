"""Train giver and receiver together with Tianshou's PPO, with one network for both.

The script needs the extras `tianshou` and `plot`, and by default MuJoCo; `--physics fast` does not need it, but
is slower.

    python experiments/training/other_libraries/train_both_tianshou.py --dataset synthetic --out runs/tianshou

Agents that share parameters need equal spaces: `handover_marl.homogeneous` pads them and adds an
agent indicator. Every agent of every world is one environment for Tianshou, so that each agent
learns from its own transitions; Tianshou's `PettingZooEnv` alternates between agents and assigns
rewards to the last one. The folder gets `giver.npz` and `receiver.npz`, extracted from the shared
network, and a learning curve.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro
from rich.progress import track
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, CollectStats, VectorReplayBuffer
from tianshou.env import BaseVectorEnv
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from tianshou.utils.torch_utils import policy_within_training_step
from torch import nn

from handover_marl.envs.arguments import AGENTS
from handover_marl.envs.wrappers.homogeneous import HomogeneousEnv, homogeneous
from handover_marl.learning.adapters.torch_modules import dense_network_from_layers
from handover_marl.learning.policy_spec import DenseNetwork
from handover_marl.learning.training.arguments import PairArgs
from handover_marl.learning.training.dense_networks import extract_agent_network
from handover_marl.learning.training.environments import make_pair_env
from handover_marl.learning.training.reward_curve import RewardCurve
from handover_marl.learning.training.training_run import TrainingRun


@dataclass(frozen=True)
class Args(PairArgs):
    """Arguments of the training with Tianshou; environments run in this process."""

    out: str = "runs/tianshou"


class AgentsVectorEnv(BaseVectorEnv):
    """Vector environment in which every agent of every two-agent environment is one environment.

    Index 2 w is the giver of the two-agent environment w, and 2 w + 1 is its receiver.

    Args:
        worlds: Two-agent environments.
        rewards: Curve to which the reward terms of finished episodes are added; default: none.
    """

    def __init__(self, worlds: Sequence[HomogeneousEnv], rewards: RewardCurve | None = None) -> None:
        self.worlds, self._rewards = worlds, rewards
        self.env_num = len(AGENTS) * len(worlds)
        self.is_async, self.is_closed = False, False
        self._seeds: list[int | None] = [None] * len(worlds)

    def get_env_attr(self, key: str, id: Any = None) -> list[Any]:  # noqa: A002
        world = self.worlds[0]
        values = {"action_space": world.action_space("giver"), "observation_space": world.observation_space("giver")}
        return [values.get(key)] * self.env_num

    def seed(self, seed: int | list[int] | None = None) -> list[list[int] | None]:
        first = seed[0] if isinstance(seed, list) else seed
        self._seeds = [None if first is None else first + number for number in range(len(self.worlds))]
        return [None if each is None else [each] for each in self._seeds for _ in AGENTS]

    def reset(self, env_id: Any = None, **kwargs: Any) -> tuple[np.ndarray, np.ndarray]:
        """Reset two-agent environments; return observations and infos of the chosen agents.

        Both agents of a two-agent environment are reset, even if only one of them is chosen.

        Args:
            env_id: Indices of the chosen agents; default: all.
            kwargs: Further arguments of Tianshou, which are ignored.
        """
        chosen = list(self._wrap_id(env_id))
        results: dict[int, tuple[Any, ...]] = {}
        for number in self._worlds_of(chosen):
            results |= self._by_id(number, self.worlds[number].reset(self._seeds[number]))
            self._seeds[number] = None
        observations, infos = zip(*(results[each] for each in chosen), strict=True)
        return np.stack(observations), np.array(infos)

    def step(self, action: Any, id: Any = None) -> tuple[np.ndarray, ...]:  # noqa: A002
        chosen = list(self._wrap_id(id))
        actions = dict(zip(chosen, action, strict=True))
        results: dict[int, tuple[Any, ...]] = {}
        for number in self._worlds_of(chosen):
            own = {agent: actions[each] for agent, each in self._ids(number).items()}
            result = self.worlds[number].step(own)
            if self._rewards is not None and not self.worlds[number].agents:
                for agent, info in result[-1].items():
                    self._rewards.add_episode(agent, info)
            results |= self._by_id(number, result)
        for each, parts in results.items():
            parts[-1]["env_id"] = each
        return tuple(np.stack(part) for part in zip(*(results[each] for each in chosen), strict=True))

    def _worlds_of(self, chosen: list[int]) -> list[int]:
        return sorted({each // len(AGENTS) for each in chosen})

    def _ids(self, number: int) -> dict[str, int]:
        return {agent: len(AGENTS) * number + place for place, agent in enumerate(AGENTS)}

    def _by_id(self, number: int, parts: tuple[dict[str, Any], ...]) -> dict[int, tuple[Any, ...]]:
        return {each: tuple(part[agent] for part in parts) for agent, each in self._ids(number).items()}

    def close(self) -> None:
        self.is_closed = True
        for world in self.worlds:
            world.close()


def normal(parts: tuple[torch.Tensor, torch.Tensor]) -> torch.distributions.Distribution:
    return torch.distributions.Independent(torch.distributions.Normal(*parts), 1)


def make_algorithm(world: HomogeneousEnv, args: Args) -> PPO:
    observations, actions = world.observation_space("giver"), world.action_space("giver")
    actor = ContinuousActorProbabilistic(
        preprocess_net=_make_net(observations, args), action_shape=actions.shape, unbounded=True
    )
    critic = ContinuousCritic(preprocess_net=_make_net(observations, args))
    with torch.no_grad():
        # First outputs are nearly zero, a sensible action.
        actor.mu.model[-1].weight.mul_(0.01)
        actor.mu.model[-1].bias.zero_()
        actor.sigma_param.copy_(torch.full((actions.shape[0], 1), math.log(args.initial_std)))
    policy = ProbabilisticActorPolicy(
        actor=actor, dist_fn=normal, action_space=actions, action_scaling=False, action_bound_method=None
    )
    return PPO(
        policy=policy,
        critic=critic,
        optim=AdamOptimizerFactory(lr=args.learning_rate),
        eps_clip=args.clip_range,
        gamma=args.discount,
        gae_lambda=args.gae_lambda,
        ent_coef=0.0,
        max_grad_norm=0.5,
    )


def _make_net(observations: Any, args: Args) -> Net:
    return Net(state_shape=observations.shape, hidden_sizes=[args.width] * 2, activation=nn.Tanh)


def extract_policy_networks(algorithm: PPO, world: HomogeneousEnv) -> dict[str, DenseNetwork]:
    """Return the network of each agent's mean actions, which are not clipped, by agent."""
    shared = dense_network_from_layers(algorithm.policy.actor, "tanh")
    return {agent: extract_agent_network(shared, world, agent) for agent in AGENTS}


def summarize(stats: CollectStats, decisions: int) -> str:
    """Return a message with the receiver's mean return in the episodes that ended in a batch.

    Args:
        stats: Statistics of the batch.
        decisions: Number of decisions so far.
    """
    returns = stats.returns[1::2] if len(stats.returns) else np.zeros(0)
    return f"{decisions} decisions" + (f", receiver's return {returns.mean():.2f}" if len(returns) else "")


def main(args: Args) -> TrainingRun:
    args = args.shrink_for_smoke_test()
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    run = TrainingRun(args, "other_libraries/train_both_tianshou", args.encodings)
    worlds = [homogeneous(make_pair_env(args)) for _ in range(args.num_envs)]
    envs = AgentsVectorEnv(worlds, run.rewards)
    envs.seed(args.seed)
    algorithm = make_algorithm(worlds[0], args)
    run.evaluate(0, extract_policy_networks(algorithm, worlds[0]))
    batch = len(AGENTS) * args.batch_size
    collector = Collector(algorithm, envs, VectorReplayBuffer(batch, len(envs)))
    collector.reset()
    for number in track(range(1, args.decisions // args.batch_size + 1), description="updates"):
        with policy_within_training_step(algorithm.policy):
            stats = collector.collect(n_step=batch)
            algorithm.update(buffer=collector.buffer, batch_size=args.minibatch_size, repeat=args.epochs)
        collector.reset_buffer(keep_statistics=True)
        decisions = number * args.batch_size
        print(summarize(stats, decisions), flush=True)
        run.rewards.write_point(decisions)
        if run.evaluate_if_due(decisions, lambda: extract_policy_networks(algorithm, worlds[0])):
            break
    envs.close()
    return run


if __name__ == "__main__":
    print(main(tyro.cli(Args)).folder.path)
