"""Train giver and receiver together by independent PPO in plain PyTorch.

The script needs the extras `train` and `plot`, and by default MuJoCo; `--physics fast` does not need it, but
is slower.

    python experiments/training/train_both_ippo.py --data-dir DIR --out runs/both

Each agent has a network of its own and treats the other agent as part of the environment (de Witt
et al., "Is independent learning all you need in the StarCraft multi-agent challenge?", 2020). The
folder gets `giver.npz` and `receiver.npz` (`--givers learned:runs/both/giver.npz`), a learning
curve, TensorBoard logs, and a checkpoint, from which `--resume` continues.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro
from gymnasium.spaces import flatdim
from rich.progress import track
from torch import nn
from torch.utils.tensorboard import SummaryWriter

from handover_marl.envs.arguments import AGENTS
from handover_marl.envs.vector.parallel_vector_env import ParallelVectorEnv
from handover_marl.learning.adapters.torch_modules import dense_network_from_module
from handover_marl.learning.training.arguments import PairArgs, ResumableArgs
from handover_marl.learning.training.dense_networks import make_mlp
from handover_marl.learning.training.environments import make_pair_vector_env
from handover_marl.learning.training.reward_curve import RewardCurve
from handover_marl.learning.training.run_folder import read_checkpoint, write_checkpoint
from handover_marl.learning.training.training_run import TrainingRun


@dataclass(frozen=True)
class Args(PairArgs, ResumableArgs):
    """Arguments of the training by independent PPO; environments run in this process.

    Attributes:
        entropy: Weight of the entropy bonus.
    """

    entropy: float = 0.0
    num_envs: int = 32
    decisions: int = 98_304
    val_scenes: int = 36
    out: str = "runs/both"
    eval_interval: int = 12_288


class ActorCritic(nn.Module):
    """Gaussian policy with a state-independent standard deviation, and a value function."""

    def __init__(self, n_inputs: int, n_outputs: int, args: Args) -> None:
        super().__init__()
        self.actor = make_mlp(n_inputs, n_outputs, args.width, 0.01)
        self.critic = make_mlp(n_inputs, 1, args.width)
        self.log_std = nn.Parameter(torch.full((n_outputs,), float(np.log(args.initial_std))))

    def compute_distribution(self, observations: torch.Tensor) -> torch.distributions.Normal:
        return torch.distributions.Normal(self.actor(observations), self.log_std.exp())

    def compute_value(self, observations: torch.Tensor) -> torch.Tensor:
        values: torch.Tensor = self.critic(observations)
        return values.squeeze(-1)


class RolloutCollector:
    """Collector of both agents' transitions from a batch of environments."""

    def __init__(self, envs: ParallelVectorEnv, seed: int, rewards: RewardCurve) -> None:
        self.envs, self.rewards = envs, rewards
        self.observations, _ = envs.reset(seed)
        self.finished_returns: list[float] = []
        self._returns = np.zeros(envs.num_envs)

    def collect(self, models: dict[str, ActorCritic], args: Args) -> dict[str, dict[str, torch.Tensor]]:
        """Collect one batch of transitions; return tensors (steps, envs, ...) by agent and quantity."""
        steps = [self._step(models, args.discount) for _ in range(args.batch_size // args.num_envs)]
        return {
            agent: {key: torch.as_tensor(np.stack([step[agent][key] for step in steps])) for key in steps[0][agent]}
            for agent in AGENTS
        }

    def _step(self, models: dict[str, ActorCritic], discount: float) -> dict[str, dict[str, np.ndarray]]:
        step = {agent: self._act(agent, model) for agent, model in models.items()}
        actions = {agent: step[agent]["action"] for agent in AGENTS}
        self.observations, rewards, terminated, truncated, infos = self.envs.step(actions)
        self._returns += rewards["receiver"]
        for agent, model in models.items():
            reward, ended = rewards[agent].astype(np.float32), terminated[agent] | truncated[agent]
            for number in np.flatnonzero(truncated[agent] & ~terminated[agent]):
                # The value of the last state stands for the rewards after the truncation.
                with torch.no_grad():
                    last = torch.as_tensor(infos[agent]["final_obs"][number])
                    reward[number] += discount * float(model.compute_value(last))
            for number in np.flatnonzero(ended):
                self.rewards.add_episode(agent, infos[agent]["final_info"][number])
            step[agent] |= {"reward": reward, "end": ended.astype(np.float32)}
        self.finished_returns += self._returns[ended].tolist()
        self._returns[ended] = 0.0
        return step

    def _act(self, agent: str, model: ActorCritic) -> dict[str, np.ndarray]:
        observations = torch.as_tensor(self.observations[agent])
        with torch.no_grad():
            distribution = model.compute_distribution(observations)
            action = distribution.sample()
            log_prob = distribution.log_prob(action).sum(-1)
            value = model.compute_value(observations)
        parts = {"observation": observations, "action": action, "log_prob": log_prob, "value": value}
        return {key: part.numpy() for key, part in parts.items()}


def compute_advantages(batch: dict[str, torch.Tensor], last_value: torch.Tensor, args: Args) -> torch.Tensor:
    """Return generalized advantage estimates (steps, envs) (Schulman et al., ICLR 2016).

    Args:
        batch: Transitions of one agent: tensors (steps, envs, ...) by quantity.
        last_value: (envs,) values of the states after the last step.
        args: Arguments with discount factor and lambda.
    """
    advantages = torch.zeros_like(batch["reward"])
    next_value, next_advantage = last_value, torch.zeros_like(last_value)
    for step in reversed(range(len(advantages))):
        continues = 1.0 - batch["end"][step]
        error = batch["reward"][step] + args.discount * next_value * continues - batch["value"][step]
        next_advantage = error + args.discount * args.gae_lambda * continues * next_advantage
        advantages[step], next_value = next_advantage, batch["value"][step]
    return advantages


def update(
    model: ActorCritic,
    optimizer: torch.optim.Optimizer,
    batch: dict[str, torch.Tensor],
    advantages: torch.Tensor,
    args: Args,
) -> dict[str, float]:
    """Update one agent's networks by PPO; return losses and statistics for the log.

    Args:
        model: Policy and value function of the agent.
        optimizer: Optimizer of the model's parameters.
        batch: Transitions of the agent: tensors (steps, envs, ...) by quantity.
        advantages: (steps, envs) advantages of the agent's actions.
        args: Arguments of the training.
    """
    targets = (advantages + batch["value"]).flatten()
    observations, actions, old_log_probs = (batch[key].flatten(0, 1) for key in ("observation", "action", "log_prob"))
    advantages = advantages.flatten()
    for _ in range(args.epochs):
        for part in torch.randperm(len(advantages)).split(args.minibatch_size):
            distribution = model.compute_distribution(observations[part])
            ratio = (distribution.log_prob(actions[part]).sum(-1) - old_log_probs[part]).exp()
            gain = (advantages[part] - advantages[part].mean()) / (advantages[part].std() + 1e-8)
            clipped = ratio.clamp(1.0 - args.clip_range, 1.0 + args.clip_range)
            surrogate = torch.min(ratio * gain, clipped * gain).mean()
            value_loss = (model.compute_value(observations[part]) - targets[part]).square().mean()
            loss = 0.5 * value_loss - surrogate - args.entropy * distribution.entropy().sum(-1).mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(model.parameters(), 0.5)
            optimizer.step()
    return {"value_loss": value_loss.item(), "std": model.log_std.exp().mean().item()}


class Learners:
    """Networks and optimizers of both agents.

    Args:
        envs: Environments, whose spaces determine the sizes of the networks.
        args: Arguments of the training.
    """

    def __init__(self, envs: ParallelVectorEnv, args: Args) -> None:
        self.models = {
            agent: ActorCritic(
                flatdim(envs.single_observation_space(agent)), envs.single_action_space(agent).shape[0], args
            )
            for agent in AGENTS
        }
        self.optimizers = {
            agent: torch.optim.Adam(model.parameters(), lr=args.learning_rate) for agent, model in self.models.items()
        }

    def update(self, collector: RolloutCollector, args: Args) -> dict[str, float]:
        """Update both agents on a new batch of transitions; return losses and statistics for the log."""
        batches = collector.collect(self.models, args)
        logged: dict[str, float] = {}
        for agent, model in self.models.items():
            with torch.no_grad():
                last_value = model.compute_value(torch.as_tensor(collector.observations[agent]))
            advantages = compute_advantages(batches[agent], last_value, args)
            found = update(model, self.optimizers[agent], batches[agent], advantages, args)
            logged |= {f"{agent}/{key}": value for key, value in found.items()}
        return logged


def restore_training(run: TrainingRun, learners: Learners) -> int:
    """Restore networks and optimizers from the checkpoint of a run; return its number of decisions."""
    done = 0

    def restore(state: dict[str, Any]) -> None:
        nonlocal done
        for agent in AGENTS:
            learners.models[agent].load_state_dict(state["models"][agent])
            learners.optimizers[agent].load_state_dict(state["optimizers"][agent])
        done = int(state["steps"])

    read_checkpoint(run.folder.checkpoint, restore)
    run.discard_points_after(done)
    return done


def save_evaluation(run: TrainingRun, learners: Learners, decisions: int, writer: SummaryWriter) -> None:
    """Evaluate the policies, and write the results and a checkpoint."""
    networks = {agent: dense_network_from_module(learners.models[agent].actor, "tanh") for agent in AGENTS}
    point = run.evaluate(decisions, networks)
    for name in ("success", "contact", "drop", "timeout"):
        writer.add_scalar(f"evaluation/{name}", getattr(point, name), decisions)
    state = {
        "steps": decisions,
        "models": {agent: learners.models[agent].state_dict() for agent in AGENTS},
        "optimizers": {agent: learners.optimizers[agent].state_dict() for agent in AGENTS},
    }
    write_checkpoint(run.folder.checkpoint, state)


def main(args: Args) -> None:
    args = args.shrink_for_smoke_test()
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    run = TrainingRun(args, "train_both_ippo", args.encodings)
    envs = make_pair_vector_env(args)
    learners = Learners(envs, args)
    done = restore_training(run, learners) if args.resume and run.folder.checkpoint.exists() else 0
    writer = SummaryWriter(str(run.folder.path / "tensorboard"))
    collector = RolloutCollector(envs, args.seed + 1000 * (done // args.batch_size), run.rewards)
    if not run.folder.points:
        save_evaluation(run, learners, 0, writer)
    numbers = range(done + args.batch_size, args.decisions + 1, args.batch_size)
    for decisions in track(numbers, description="updates"):
        logged = learners.update(collector, args)
        logged |= {f"rewards/{name}": mean for name, mean in run.rewards.write_point(decisions).items()}
        if collector.finished_returns:
            logged["rollout/receiver_return"] = float(np.mean(collector.finished_returns))
            collector.finished_returns.clear()
        for name, value in logged.items():
            writer.add_scalar(name, value, decisions)
        if run.is_evaluation_due(decisions):
            save_evaluation(run, learners, decisions, writer)
        if run.is_finished(decisions):
            break
    writer.close()
    envs.close()
    print(run.folder.path)


if __name__ == "__main__":
    main(tyro.cli(Args))
