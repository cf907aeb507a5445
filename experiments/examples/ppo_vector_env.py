"""Train a receiver by PPO in plain PyTorch on a vector environment.

    python experiments/examples/ppo_vector_env.py --dataset synthetic --out runs/ppo.npz

The script needs the extras `train` and `mujoco`. The giver is frozen. The policy file runs without PyTorch:
`handover-marl benchmark --setup s0 --receiver learned:runs/ppo.npz`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import nn
from torch.distributions import Normal

import handover_marl
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import PolicySpec
from handover_marl.learning.training.dense_networks import dense_network_from_module, make_mlp

FEATURES, ACTIONS, CONTROL_PERIOD = "close", "grasp_servo", 0.2
EPOCHS, MINIBATCH_SIZE, DISCOUNT, GAE_LAMBDA, CLIP_RANGE = 8, 128, 0.97, 0.95, 0.2


@dataclass(frozen=True)
class Args:
    """Arguments of the training of a receiver by PPO.

    Attributes:
        out: Policy file to write.
        seed: Seed of all random numbers.
        giver: Name of the frozen giver.
        dataset: Dataset: dexycb, synthetic, or auto.
        num_envs: Number of environments, which are simulated in one batch.
        rollout: Number of environment steps between updates.
        updates: Number of PPO updates.
        learning_rate: Learning rate of Adam.
    """

    out: Path = Path("runs/ppo.npz")
    seed: int = 0
    giver: str = "cooperative"
    dataset: str = "auto"
    num_envs: int = 64
    rollout: int = 32
    updates: int = 100
    learning_rate: float = 7e-4


def main(args: Args) -> list[float]:
    torch.manual_seed(args.seed)
    envs = handover_marl.vector_env(
        args.num_envs,
        "receiver",
        args.giver,
        features=FEATURES,
        schemes=ACTIONS,
        autoreset="same_step",
        dataset=args.dataset,
        control_period=CONTROL_PERIOD,
        max_cycles=40,
    )
    n_inputs, n_outputs = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    actor, critic = make_mlp(n_inputs, n_outputs, gain=0.01), make_mlp(n_inputs, 1)
    log_std = nn.Parameter(torch.full((n_outputs,), -1.5))
    parameters = [*actor.parameters(), *critic.parameters(), log_std]
    optimizer = torch.optim.Adam(parameters, args.learning_rate)
    observation, _ = envs.reset(seed=args.seed)
    success_rates = []
    for update in range(args.updates):
        steps, outcomes = [], []
        for _ in range(args.rollout):
            with torch.no_grad():
                inputs = torch.as_tensor(observation)
                policy = Normal(actor(inputs), log_std.exp())
                action = policy.sample()
                log_prob, value = policy.log_prob(action).sum(-1), critic(inputs)[:, 0]
            observation, reward, terminated, truncated, infos = envs.step(action.numpy())
            for number in np.flatnonzero(terminated | truncated):
                outcomes.append(infos["final_info"]["status"][number] == handover_marl.EpisodeStatus.SUCCESS)
                if not terminated[number]:
                    # The value of the last state stands for the rewards after the truncation.
                    last = torch.as_tensor(infos["final_obs"][number])
                    reward[number] += DISCOUNT * critic(last).item()
            reward, continues = torch.as_tensor(reward), torch.as_tensor(~(terminated | truncated))
            steps.append((inputs, action, log_prob, value, reward.float(), continues.float()))
        inputs, actions, log_probs, values, rewards, continues = map(torch.stack, zip(*steps, strict=True))
        advantages, advantage = torch.zeros_like(rewards), torch.zeros(args.num_envs)
        next_value = critic(torch.as_tensor(observation))[:, 0].detach()
        for step in reversed(range(args.rollout)):
            error = rewards[step] + DISCOUNT * next_value * continues[step] - values[step]
            advantage = error + DISCOUNT * GAE_LAMBDA * continues[step] * advantage
            advantages[step], next_value = advantage, values[step]
        targets, gains = (advantages + values).flatten(), (advantages / (advantages.std() + 1e-8)).flatten()
        inputs, actions, log_probs = inputs.flatten(0, 1), actions.flatten(0, 1), log_probs.flatten()
        for _ in range(EPOCHS):
            for part in torch.randperm(len(gains)).split(MINIBATCH_SIZE):
                policy = Normal(actor(inputs[part]), log_std.exp())
                ratio = (policy.log_prob(actions[part]).sum(-1) - log_probs[part]).exp()
                clipped = ratio.clamp(1.0 - CLIP_RANGE, 1.0 + CLIP_RANGE)
                policy_loss = -torch.min(ratio * gains[part], clipped * gains[part]).mean()
                value_loss = (critic(inputs[part])[:, 0] - targets[part]).square().mean()
                optimizer.zero_grad()
                (policy_loss + 0.5 * value_loss).backward()
                nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()
        success_rates.append(sum(outcomes) / max(1, len(outcomes)))
        print(f"update {update}: success of {len(outcomes)} episodes {success_rates[-1]:.0%}", flush=True)
    envs.close()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    spec = PolicySpec("receiver", FEATURES, ACTIONS, CONTROL_PERIOD, "experiments/examples/ppo_vector_env.py")
    write_policy(args.out, spec, dense_network_from_module(actor))
    return success_rates


if __name__ == "__main__":
    main(tyro.cli(Args))
