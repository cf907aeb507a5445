"""Train giver and receiver together by PPO in plain PyTorch: IPPO, or MAPPO with `--critic both`.

    python experiments/training/train_both_ppo.py --data-dir DIR --seed 0 --out runs/both0

The giver chooses the pose in which it holds out the object; the receiver corrects the approach to a grasp and chooses
when to close the gripper. Both get the reward of a success. In MAPPO (Yu et al., NeurIPS 2022) the value functions
observe the features of both agents. The folder gets `giver.npz` and `receiver.npz`. Agents of several seeds are
compared with partners that they never met by

    handover-marl crossplay --givers learned:runs/both0/giver.npz,learned:runs/both1/giver.npz \
        --receivers learned:runs/both0/receiver.npz,learned:runs/both1/receiver.npz --split val
"""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from gymnasium.spaces import flatdim
from pair import FEATURES, SCHEMES, PairArgs, write_pair
from train_receiver_ppo import ActorCritic, Batch, compute_advantages, update

import handover_marl
from handover_marl.envs.agents import AGENTS
from handover_marl.learning.adapters.modules import dense_network_from_module
from handover_marl.learning.training.run_folder import spawn_seeds
from handover_marl.learning.training.scene_arguments import run_script


@dataclass(frozen=True)
class Args(PairArgs):
    """Arguments of the training of giver and receiver by PPO.

    Attributes:
        critic: Features that an agent's value function observes: "own", or "both" for those of both agents.
        workers: Number of processes that simulate the environments.
    """

    critic: Literal["own", "both"] = "own"
    decisions: int = 1_000_000
    num_envs: int = 128
    workers: int = 2


class Collector:
    """Collector of the decisions of both agents in environments of a process."""

    def __init__(self, number: int, args: Args) -> None:
        self.args, count = args, args.num_envs // args.workers
        self.envs = handover_marl.vector_env(
            count,
            None,
            features=FEATURES,
            action_scheme=SCHEMES,
            autoreset="same_step",
            processes=1,
            **args.env_options,
        )
        noise_seed, *seeds = spawn_seeds(1 + count, args.seed, number)
        self.generator = torch.Generator().manual_seed(noise_seed)
        self.features = self._join(self.envs.reset(seed=seeds)[0])
        self.outcomes: list[bool] = []

    def _join(self, observations: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
        """Return the features of each agent, followed by those of the other agent if value functions observe both."""
        own = [torch.as_tensor(observations[agent]) for agent in AGENTS]
        if self.args.critic == "both":
            own = [torch.cat(parts, -1) for parts in (own, own[::-1])]
        return dict(zip(AGENTS, own, strict=True))

    @torch.no_grad()
    def collect(self, learners: dict[str, ActorCritic]) -> dict[str, Batch]:
        """Take steps for one update; return each agent's decisions, and keep the outcomes of episodes that ended."""
        self.outcomes = []
        steps = [self._step(learners) for _ in range(self.args.batch_size // self.args.num_envs)]
        batches = {}
        for agent, learner in learners.items():
            parts = map(torch.stack, zip(*(step[agent] for step in steps), strict=True))
            features, actions, log_probs, values, rewards, continues = parts
            last_values = learner.compute_value(self.features[agent])
            advantages = compute_advantages(rewards, values, continues, last_values, self.args)
            batches[agent] = Batch(features, actions, log_probs, advantages, advantages + values)
        return batches

    def _step(self, learners: dict[str, ActorCritic]) -> dict[str, tuple[torch.Tensor, ...]]:
        features = self.features
        policies = {agent: learner.compute_distribution(features[agent]) for agent, learner in learners.items()}
        noise = {agent: torch.randn(policy.mean.shape, generator=self.generator) for agent, policy in policies.items()}
        actions = {agent: policy.mean + policy.stddev * noise[agent] for agent, policy in policies.items()}
        found, rewards, terminated, truncated, infos = self.envs.step({a: own.numpy() for a, own in actions.items()})
        ended = terminated["receiver"] | truncated["receiver"]
        for number in np.flatnonzero(ended).tolist():
            status = int(infos["receiver"]["final_info"]["status"][number])
            self.outcomes.append(status == handover_marl.EpisodeStatus.SUCCESS)
            if not terminated["receiver"][number]:
                # The value of the last state stands for the rewards after the truncation.
                last = self._join({agent: infos[agent]["final_obs"][number] for agent in AGENTS})
                for agent, learner in learners.items():
                    rewards[agent][number] += self.args.discount * learner.compute_value(last[agent]).item()
        self.features, continues = self._join(found), torch.as_tensor(~ended).float()
        return {
            agent: (
                features[agent],
                actions[agent],
                policies[agent].log_prob(actions[agent]).sum(-1),
                learner.compute_value(features[agent]),
                torch.as_tensor(rewards[agent]).float(),
                continues,
            )
            for agent, learner in learners.items()
        }


def train(args: Args) -> dict[str, ActorCritic]:
    """Train both agents until the number of decisions is reached, and return their networks."""
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)  # The networks are small, and the other cores simulate.
    with ThreadPoolExecutor(args.workers) as pool:
        collectors = list(pool.map(lambda number: Collector(number, args), range(args.workers)))
        envs, learners, decisions, started = collectors[0].envs, {}, 0, time.monotonic()
        for agent in AGENTS:
            n_inputs = flatdim(envs.single_observation_space(agent))
            stds = [args.initial_std] * envs.single_action_space(agent).shape[0]
            n_features = collectors[0].features[agent].shape[-1]
            learners[agent] = ActorCritic(n_inputs, stds, args.width, n_features=n_features)
        optimizers = {agent: torch.optim.Adam(own.parameters(), args.learning_rate) for agent, own in learners.items()}
        while decisions < args.decisions:
            found = list(pool.map(lambda collector: collector.collect(learners), collectors))
            for agent, learner in learners.items():
                parts = zip(*(batches[agent] for batches in found), strict=True)
                update(learner, optimizers[agent], Batch(*(torch.cat(part, dim=1) for part in parts)), args)
            decisions += args.batch_size
            outcomes = [outcome for collector in collectors for outcome in collector.outcomes]
            print(
                f"{decisions} decisions of each agent, {decisions / (time.monotonic() - started):.0f} decisions/s: "
                f"success of {len(outcomes)} training episodes {sum(outcomes) / max(1, len(outcomes)):.1%}",
                flush=True,
            )
    for collector in collectors:
        collector.envs.close()
    return learners


def main(args: Args) -> None:
    learners = train(args.resolve_setup())
    networks = {agent: dense_network_from_module(learner.actor, "tanh") for agent, learner in learners.items()}
    write_pair(networks, args, "train_both_ppo")


if __name__ == "__main__":
    run_script(main, Args, __doc__)
