"""Train giver and receiver together with Tianshou's PPO, with networks of their own for both agents.

    python experiments/training/other_libraries/train_both_tianshou.py --dataset synthetic --out runs/tianshou

Tianshou's collectors have one agent, so the loop fills a replay buffer for each agent. It needs the extra `tianshou`.
"""

import math
from typing import Any

import numpy as np
import torch
from pair import PairArgs, make_env, write_pair
from rich.progress import track
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, VectorReplayBuffer
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch import nn
from torch.distributions import Independent, Normal

from handover_marl.envs.arguments import AGENTS
from handover_marl.envs.wrappers.encode import EncodedEnv
from handover_marl.learning.adapters.modules import dense_network_from_layers
from handover_marl.learning.training.run_folder import spawn_seeds
from handover_marl.learning.training.scene_arguments import run_script


def make_algorithm(env: EncodedEnv, agent: str, args: PairArgs) -> PPO:
    """Make PPO with an actor and a critic for one agent; the mean action is nearly zero before the training."""
    n_inputs, actions = env.observation_space(agent).shape[0], env.action_space(agent)
    nets = [Net(state_shape=(n_inputs,), hidden_sizes=[args.width] * 2, activation=nn.Tanh) for _ in range(2)]
    actor = ContinuousActorProbabilistic(preprocess_net=nets[0], action_shape=actions.shape, unbounded=True)
    for parameter, scale in ((actor.mu.model[-1].weight, 0.01), (actor.mu.model[-1].bias, 0.0)):
        parameter.data.mul_(scale)
    actor.sigma_param.data.fill_(math.log(args.initial_std))
    scaling: dict[str, Any] = {"action_space": actions, "action_scaling": False, "action_bound_method": None}
    policy = ProbabilisticActorPolicy(actor=actor, dist_fn=lambda parts: Independent(Normal(*parts), 1), **scaling)
    policy.is_within_training_step = True  # draws actions at random
    critic, optimizer = ContinuousCritic(preprocess_net=nets[1]), AdamOptimizerFactory(lr=args.learning_rate)
    options = {"eps_clip": args.clip_range, "gamma": args.discount, "gae_lambda": args.gae_lambda, "ent_coef": 0.0}
    return PPO(policy=policy, critic=critic, optim=optimizer, max_grad_norm=0.5, **options)


def main(args: PairArgs) -> None:
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    envs = [make_env(args) for _ in range(args.num_envs)]
    seeds = spawn_seeds(args.num_envs, args.seed)
    seen = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=True)]
    algorithms = {agent: make_algorithm(envs[0], agent, args) for agent in AGENTS}
    buffers = {agent: VectorReplayBuffer(args.batch_size, args.num_envs) for agent in AGENTS}
    names = ("obs_next", "rew", "terminated", "truncated")
    for number in track(range(args.decisions // args.num_envs), description="decisions"):
        batches = {agent: Batch(obs=np.stack([one[agent] for one in seen]), info={}) for agent in AGENTS}
        for agent, batch in batches.items():
            with torch.no_grad():
                batch.act = algorithms[agent].policy(batch).act.numpy()
        steps: list[Any] = [env.step({agent: batches[agent].act[n] for agent in AGENTS}) for n, env in enumerate(envs)]
        for agent, batch in batches.items():
            batch.update({name: np.array([step[n][agent] for step in steps]) for n, name in enumerate(names)})
            batch.done = batch.terminated | batch.truncated
            buffers[agent].add(batch)
        seen = [step[0] if env.agents else env.reset()[0] for env, step in zip(envs, steps, strict=True)]
        if (number + 1) % (args.batch_size // args.num_envs) == 0:
            for agent, buffer in buffers.items():
                algorithms[agent].update(buffer=buffer, batch_size=args.minibatch_size, repeat=args.epochs)
                buffer.reset()
    for env in envs:
        env.close()
    networks = {agent: dense_network_from_layers(each.policy.actor, "tanh") for agent, each in algorithms.items()}
    write_pair(networks, args, "train_both_tianshou")


if __name__ == "__main__":
    run_script(main, PairArgs)
