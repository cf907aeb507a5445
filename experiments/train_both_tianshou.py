"""Train giver and receiver at once with Tianshou's PPO, one network for both.

Needs the extras `tianshou`, `plot` and, for its default, `mujoco`; or `--physics fast`, slower.

    python experiments/train_both_tianshou.py --dataset synthetic --out runs/tianshou

Agents that share parameters need equal spaces: `handover_marl.homogeneous` pads them and says who is who. For Tianshou
every agent of every world counts as an environment, so that each learns from what it saw itself; its `PettingZooEnv`
lets agents act in turn, and would give rewards to whoever acts last. The folder gets `giver.npz` and `receiver.npz`,
cut out of the one network, and a learning curve.
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

from handover_marl.envs.homogeneous import HomogeneousEnv, homogeneous
from handover_marl.learning.network import Network
from handover_marl.training.dense_layers import dense_layers, own_part
from handover_marl.training.pair_run import PairArgs, PairRun, pair_env

AGENTS = ("giver", "receiver")


@dataclass(frozen=True)
class Args(PairArgs):
    """What to train, and how. Worlds are stepped one after the other in this process."""

    out: str = "runs/tianshou"


class AgentsVectorEnv(BaseVectorEnv):
    """Every agent of every world as an environment: number 2 w is the giver of world w, 2 w + 1 its receiver."""

    def __init__(self, worlds: Sequence[HomogeneousEnv]) -> None:
        self.worlds = worlds
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
        """All agents of a world at once, as they end."""
        chosen = list(self._wrap_id(env_id))
        results: dict[int, tuple[Any, ...]] = {}
        for number in self._worlds_of(chosen):
            results |= self._by_id(number, self.worlds[number].reset(self._seeds[number]))
            self._seeds[number] = None
        seen, infos = zip(*(results[each] for each in chosen), strict=True)
        return np.stack(seen), np.array(infos)

    def step(self, action: Any, id: Any = None) -> tuple[np.ndarray, ...]:  # noqa: A002
        chosen = list(self._wrap_id(id))
        actions = dict(zip(chosen, action, strict=True))
        results: dict[int, tuple[Any, ...]] = {}
        for number in self._worlds_of(chosen):
            own = {agent: actions[each] for agent, each in self._ids(number).items()}
            results |= self._by_id(number, self.worlds[number].step(own))
        for each, result in results.items():
            result[-1]["env_id"] = each
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
    seen, done = world.observation_space("giver"), world.action_space("giver")
    size = done.shape[0]
    actor = ContinuousActorProbabilistic(preprocess_net=_net(seen, args), action_shape=done.shape, unbounded=True)
    critic = ContinuousCritic(preprocess_net=_net(seen, args))
    with torch.no_grad():
        # At first all do as the action schemes do with zeros.
        actor.mu.model[-1].weight.mul_(0.01)
        actor.mu.model[-1].bias.zero_()
        actor.sigma_param.copy_(torch.full((size, 1), math.log(args.spread)))
    policy = ProbabilisticActorPolicy(
        actor=actor, dist_fn=normal, action_space=done, action_scaling=False, action_bound_method=None
    )
    return PPO(
        policy=policy,
        critic=critic,
        optim=AdamOptimizerFactory(lr=args.learning_rate),
        eps_clip=args.clip,
        gamma=args.discount,
        gae_lambda=args.trace,
        ent_coef=0.0,
        max_grad_norm=0.5,
    )


def _net(seen: Any, args: Args) -> Net:
    return Net(state_shape=seen.shape, hidden_sizes=[args.width] * 2, activation=nn.Tanh)


def networks(algorithm: PPO, world: HomogeneousEnv) -> dict[str, Network]:
    """Each agent's part of the one network, without noise: the means, which action schemes clip."""
    whole = dense_layers(algorithm.policy.actor)
    return {agent: own_part(whole, world, agent) for agent in AGENTS}


def told(stats: CollectStats, steps: int) -> str:
    """How the episodes that ended in a batch went."""
    returns = stats.returns[1::2] if len(stats.returns) else np.zeros(0)
    return f"{steps} decisions" + (f", receiver's return {returns.mean():.2f}" if len(returns) else "")


def main(args: Args) -> PairRun:
    args = args.sized()
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    run = PairRun(args, "train_both_tianshou")
    worlds = [homogeneous(pair_env(args)) for _ in range(args.envs)]
    envs = AgentsVectorEnv(worlds)
    envs.seed(args.seed)
    algorithm = make_algorithm(worlds[0], args)
    run.assess(0, networks(algorithm, worlds[0]))
    batch = len(AGENTS) * args.batch
    collector = Collector(algorithm, envs, VectorReplayBuffer(batch, len(envs)))
    collector.reset()
    for number in track(range(1, args.steps // args.batch + 1), description="updates"):
        with policy_within_training_step(algorithm.policy):
            stats = collector.collect(n_step=batch)
            algorithm.update(buffer=collector.buffer, batch_size=args.minibatch, repeat=args.epochs)
        collector.reset_buffer(keep_statistics=True)
        steps = number * args.batch
        print(told(stats, steps), flush=True)
        if run.due(steps):
            run.assess(steps, networks(algorithm, worlds[0]))
        if run.over(steps):
            break
    envs.close()
    return run


if __name__ == "__main__":
    print(main(tyro.cli(Args)).folder.path)
