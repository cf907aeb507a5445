"""Train giver and receiver together with Tianshou's PPO, with one network for both.

    python experiments/training/other_libraries/train_both_tianshou.py --dataset synthetic --out runs/tianshou

Agents that share parameters need equal spaces: `handover_marl.homogeneous` pads them and adds an agent indicator.
Every agent is one environment for Tianshou, so that it learns from its own transitions. The script needs the extra
`tianshou`.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import tyro
from pair import PairArgs, make_env, write_pair
from rich.progress import track
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import BaseVectorEnv
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from tianshou.utils.torch_utils import policy_within_training_step
from torch import nn
from torch.distributions import Independent, Normal

from handover_marl import homogeneous
from handover_marl.envs.arguments import AGENTS
from handover_marl.learning.adapters.export import dense_network_from_layers


class AgentsVectorEnv(BaseVectorEnv):
    """Environments of both agents of each world: 2 w of the giver in world w, 2 w + 1 of the receiver."""

    def __init__(self, args: PairArgs) -> None:
        self.worlds = [homogeneous(make_env(args)) for _ in range(args.num_envs)]
        self.env_num, self.is_async, self.is_closed = 2 * len(self.worlds), False, False
        self.seeds: list[int | None] = [args.seed + number for number in range(len(self.worlds))]

    def get_env_attr(self, key: str, id: Any = None) -> list[Any]:  # noqa: A002
        return [getattr(self.worlds[0], key)("giver") if key.endswith("_space") else None] * self.env_num

    def reset(self, env_id: Any = None, **kwargs: Any) -> tuple[np.ndarray, np.ndarray]:
        # Episodes end for both agents at once, so that their numbers come in pairs.
        parts = []
        for number in [each // 2 for each in self._wrap_id(env_id)][::2]:
            parts.append(self.worlds[number].reset(self.seeds[number]))
            self.seeds[number] = None
        observations, infos = ([part[kind][agent] for part in parts for agent in AGENTS] for kind in (0, 1))
        return np.stack(observations), np.array(infos)

    def step(self, action: Any, id: Any = None) -> tuple[np.ndarray, ...]:  # noqa: A002
        chosen, steps = self._wrap_id(id), []
        for row in range(0, len(chosen), 2):
            actions = dict(zip(AGENTS, action[row : row + 2], strict=True))
            steps.append(self.worlds[chosen[row] // 2].step(actions))
        *parts, infos = ([step[kind][agent] for step in steps for agent in AGENTS] for kind in range(5))
        for number, info in zip(chosen, infos, strict=True):
            info["env_id"] = number
        return *map(np.stack, parts), np.array(infos)

    def close(self) -> None:
        for world in self.worlds:
            world.close()


def main(args: PairArgs) -> None:
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    envs = AgentsVectorEnv(args)
    world, (n_inputs,) = envs.worlds[0], envs.worlds[0].observation_space("giver").shape
    actions = world.action_space("giver")
    nets = [Net(state_shape=(n_inputs,), hidden_sizes=[args.width] * 2, activation=nn.Tanh) for _ in range(2)]
    actor = ContinuousActorProbabilistic(preprocess_net=nets[0], action_shape=actions.shape, unbounded=True)
    with torch.no_grad():  # first outputs are nearly zero, a sensible action
        actor.mu.model[-1].weight.mul_(0.01)
        actor.mu.model[-1].bias.zero_()
        actor.sigma_param.fill_(math.log(args.initial_std))
    policy = ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=lambda parts: Independent(Normal(*parts), 1),
        action_space=actions,
        action_scaling=False,
        action_bound_method=None,
    )
    algorithm = PPO(
        policy=policy,
        critic=ContinuousCritic(preprocess_net=nets[1]),
        optim=AdamOptimizerFactory(lr=args.learning_rate),
        eps_clip=args.clip_range,
        gamma=args.discount,
        gae_lambda=args.gae_lambda,
        ent_coef=0.0,
        max_grad_norm=0.5,
    )
    count = 2 * args.batch_size
    collector = Collector(algorithm, envs, VectorReplayBuffer(count, len(envs)))
    collector.reset()
    for _ in track(range(args.decisions // args.batch_size), description="updates"):
        with policy_within_training_step(algorithm.policy):
            collector.collect(n_step=count)
            algorithm.update(buffer=collector.buffer, batch_size=args.minibatch_size, repeat=args.epochs)
        collector.reset_buffer(keep_statistics=True)
    envs.close()
    shared = dense_network_from_layers(actor, "tanh")
    networks = {}
    for place, agent in enumerate(AGENTS):
        # The indicator is constant, so its column is part of the bias; the padding is zero.
        sizes, first = world.get_sizes(agent), shared.weights[0]
        weights = [first[:, : sizes[0]], *shared.weights[1:-1], shared.weights[-1][: sizes[1]]]
        biases = [shared.biases[0] + first[:, place - len(AGENTS)], *shared.biases[1:-1], shared.biases[-1][: sizes[1]]]
        networks[agent] = replace(shared, weights=tuple(weights), biases=tuple(biases))
    write_pair(networks, args, "train_both_tianshou")


if __name__ == "__main__":
    main(tyro.cli(PairArgs))
