"""Train giver and receiver together in a PettingZoo loop, in plain PyTorch.

    python experiments/examples/pettingzoo_two_learners.py --dataset synthetic

The script needs the extra `train`. Each agent has its own actor and critic and learns by the advantages of its
own rewards (advantage actor-critic), so that the other agent is a part of its environment.
"""

from dataclasses import dataclass

import numpy as np
import torch
import tyro
from torch import nn
from torch.distributions import Normal

import handover_marl

# Names of the features that replace observations, and of the action schemes that decode outputs.
FEATURES = {"giver": "giver", "receiver": "close"}
SCHEMES = {"giver": "offer", "receiver": "grasp_servo"}
LEARNING_RATE, DISCOUNT = 1e-3, 0.95


@dataclass(frozen=True)
class Args:
    """Arguments of the training of giver and receiver.

    Attributes:
        dataset: Dataset: dexycb, synthetic, or auto.
        physics: Physics engine: fast, exact or mujoco.
        seed: Seed of all random numbers.
        episodes: Number of episodes.
        batch: Number of episodes between updates.
        max_cycles: Number of environment steps after which an episode is truncated.
    """

    dataset: str = "auto"
    physics: str = "fast"
    seed: int = 0
    episodes: int = 1000
    batch: int = 10
    max_cycles: int = 40


class Learner:
    """Actor-critic learner of one agent; it stores the steps of episodes until `update`."""

    def __init__(self, n_inputs: int, n_outputs: int) -> None:
        hidden, last = nn.Linear(n_inputs, 64), nn.Linear(64, n_outputs)
        last.weight.data.mul_(0.01)  # first outputs near zero, a sensible action
        self._actor = nn.Sequential(hidden, nn.Tanh(), last)
        self._critic = nn.Sequential(nn.Linear(n_inputs, 64), nn.Tanh(), nn.Linear(64, 1))
        self._log_std = nn.Parameter(torch.full((n_outputs,), -1.0))
        parameters = [*self._actor.parameters(), *self._critic.parameters(), self._log_std]
        self._optimizer = torch.optim.Adam(parameters, LEARNING_RATE)
        self._steps, self._returns = list[tuple[torch.Tensor, torch.Tensor]](), list[float]()

    def act(self, features: np.ndarray) -> np.ndarray:
        """Sample outputs for a feature vector from the policy, and store both for the next update."""
        inputs = torch.as_tensor(features)
        with torch.no_grad():
            action: torch.Tensor = Normal(self._actor(inputs), self._log_std.exp()).sample()
        self._steps.append((inputs, action))
        return action.numpy()

    def finish_episode(self, rewards: list[float]) -> None:
        """Store the discounted returns of a finished episode for the next update."""
        returns, value = [], 0.0
        for reward in reversed(rewards):
            value = reward + DISCOUNT * value
            returns.append(value)
        self._returns += reversed(returns)

    def update(self) -> None:
        """Take one gradient step on all episodes since the last update."""
        inputs, actions = (torch.stack(part) for part in zip(*self._steps, strict=True))
        returns = torch.tensor(self._returns)
        values = self._critic(inputs)[:, 0]
        advantages = (returns - values).detach()
        log_probs = Normal(self._actor(inputs), self._log_std.exp()).log_prob(actions).sum(-1)
        loss = (values - returns).square().mean() - (log_probs * advantages).mean()
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        self._steps, self._returns = [], []


def main(args: Args) -> dict[str, Learner]:
    torch.manual_seed(args.seed)
    env = handover_marl.parallel_env(
        dataset=args.dataset, physics=args.physics, rewards="shaped", control_period=0.2, max_cycles=args.max_cycles
    )
    env = handover_marl.encode(env, FEATURES, SCHEMES)
    learners = {
        agent: Learner(env.observation_space(agent).shape[0], env.action_space(agent).shape[0])
        for agent in env.possible_agents
    }
    successes = []
    for episode in range(args.episodes):
        observations, infos = env.reset(seed=args.seed if episode == 0 else None)
        rewards: dict[str, list[float]] = {agent: [] for agent in learners}
        while env.agents:
            actions = {agent: learners[agent].act(observations[agent]) for agent in env.agents}
            observations, step_rewards, _, _, infos = env.step(actions)
            for agent, reward in step_rewards.items():
                rewards[agent].append(float(reward))
        successes.append(infos["receiver"]["status"] == handover_marl.EpisodeStatus.SUCCESS)
        for agent, learner in learners.items():
            learner.finish_episode(rewards[agent])
        if (episode + 1) % args.batch == 0:
            for learner in learners.values():
                learner.update()
            print(f"{episode + 1} episodes, success {np.mean(successes[-args.batch :]):.0%}", flush=True)
    env.close()
    return learners


if __name__ == "__main__":
    main(tyro.cli(Args))
