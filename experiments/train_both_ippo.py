"""Train giver and receiver at once by independent PPO: plain PyTorch on batches of both agents.

Needs the extras `train`, `plot` and, for its default, `mujoco`; or `--physics fast`, slower.

    python experiments/train_both_ippo.py --data-dir DIR --out runs/both

Each agent has a network of its own and takes the other for a part of the world (de Witt et al., "Is independent
learning all you need in the StarCraft multi-agent challenge?", 2020). The folder gets `giver.npz` and
`receiver.npz` (`--givers learned:runs/both/giver.npz`), a learning curve, TensorBoard logs, and a checkpoint:
`--resume` goes on where a run was stopped.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro
from rich.progress import track
from torch import nn
from torch.utils.tensorboard import SummaryWriter

from handover_marl.envs.parallel_vector_env import ParallelVectorEnv
from handover_marl.training.checkpoint import read_checkpoint, write_checkpoint
from handover_marl.training.dense_layers import dense_layers, mlp
from handover_marl.training.pair_run import PairArgs, PairRun, pair_envs
from handover_marl.training.training_args import TrainingArgs

AGENTS = ("giver", "receiver")


@dataclass(frozen=True)
class Args(PairArgs, TrainingArgs):
    """What to train, and how. Environments are stepped together in this process.

    Attributes:
        entropy: Weight of the entropy bonus.
    """

    out: str = "runs/both"
    steps: int = 98_304
    envs: int = 32
    val_scenes: int = 36
    every: int = 12_288
    entropy: float = 0.0


class ActorCritic(nn.Module):
    """A Gaussian policy and a value, two hidden layers each."""

    def __init__(self, n_inputs: int, n_outputs: int, args: Args) -> None:
        super().__init__()
        self.actor = mlp(n_inputs, n_outputs, args.width, 0.01)
        self.critic = mlp(n_inputs, 1, args.width)
        self.log_std = nn.Parameter(torch.full((n_outputs,), float(np.log(args.spread))))

    def distribution(self, seen: torch.Tensor) -> torch.distributions.Normal:
        return torch.distributions.Normal(self.actor(seen), self.log_std.exp())

    def value(self, seen: torch.Tensor) -> torch.Tensor:
        return self.critic(seen).squeeze(-1)


class Collector:
    """Steps environments together and keeps what both agents saw, did and got."""

    def __init__(self, envs: ParallelVectorEnv, seed: int) -> None:
        self.envs = envs
        self.seen, _ = envs.reset(seed)
        self.finished: list[float] = []
        self._returns = np.zeros(envs.num_envs)

    def collect(self, models: dict[str, ActorCritic], args: Args) -> dict[str, dict[str, torch.Tensor]]:
        steps = [self._step(models, args.discount) for _ in range(args.batch // args.envs)]
        return {
            agent: {key: torch.as_tensor(np.stack([step[agent][key] for step in steps])) for key in steps[0][agent]}
            for agent in AGENTS
        }

    def stacked(self, agent: str) -> torch.Tensor:
        return torch.as_tensor(self.seen[agent])

    def _step(self, models: dict[str, ActorCritic], discount: float) -> dict[str, dict[str, np.ndarray]]:
        now = {agent: self._act(agent, model) for agent, model in models.items()}
        self.seen, rewards, over, cut_off, infos = self.envs.step({agent: now[agent]["action"] for agent in AGENTS})
        self._returns += rewards["receiver"]
        for agent, model in models.items():
            reward, ended = rewards[agent].astype(np.float32), over[agent] | cut_off[agent]
            for number in np.flatnonzero(cut_off[agent] & ~over[agent]):
                # Cut off, not over: what would have come counts.
                with torch.no_grad():
                    last = torch.as_tensor(infos[agent]["final_obs"][number])
                    reward[number] += discount * float(model.value(last))
            now[agent] |= {"reward": reward, "end": ended.astype(np.float32)}
        self.finished += self._returns[ended].tolist()
        self._returns[ended] = 0.0
        return now

    def _act(self, agent: str, model: ActorCritic) -> dict[str, np.ndarray]:
        seen = self.stacked(agent)
        with torch.no_grad():
            distribution = model.distribution(seen)
            action = distribution.sample()
            log = distribution.log_prob(action).sum(-1)
            parts = {"seen": seen, "action": action, "log": log, "value": model.value(seen)}
        return {key: value.numpy() for key, value in parts.items()}


def advantages(batch: dict[str, torch.Tensor], last: torch.Tensor, args: Args) -> torch.Tensor:
    """Generalised advantage estimates (Schulman et al., 2016), (t, n)."""
    result = torch.zeros_like(batch["reward"])
    following, trace = last, torch.zeros_like(last)
    for step in reversed(range(len(result))):
        goes_on = 1.0 - batch["end"][step]
        error = batch["reward"][step] + args.discount * following * goes_on - batch["value"][step]
        trace = error + args.discount * args.trace * goes_on * trace
        result[step], following = trace, batch["value"][step]
    return result


def update(
    model: ActorCritic,
    optimizer: torch.optim.Optimizer,
    batch: dict[str, torch.Tensor],
    gain: torch.Tensor,
    args: Args,
) -> dict[str, float]:
    """PPO's update of one agent; returns what there is to log."""
    wanted = (gain + batch["value"]).flatten()
    flat = {key: batch[key].flatten(0, 1) for key in ("seen", "action", "log")}
    gain = gain.flatten()
    for _ in range(args.epochs):
        for part in torch.randperm(len(gain)).split(args.minibatch):
            distribution = model.distribution(flat["seen"][part])
            ratio = (distribution.log_prob(flat["action"][part]).sum(-1) - flat["log"][part]).exp()
            better = (gain[part] - gain[part].mean()) / (gain[part].std() + 1e-8)
            surrogate = torch.min(ratio * better, ratio.clamp(1.0 - args.clip, 1.0 + args.clip) * better).mean()
            missed = (model.value(flat["seen"][part]) - wanted[part]).square().mean()
            loss = 0.5 * missed - surrogate - args.entropy * distribution.entropy().sum(-1).mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(model.parameters(), 0.5)
            optimizer.step()
    return {"value_loss": missed.item(), "std": model.log_std.exp().mean().item()}


def main(args: Args) -> None:
    args = args.sized()
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    run = PairRun(args, "train_both_ippo")
    folder = run.folder
    envs = pair_envs(args)
    models = {
        agent: ActorCritic(
            envs.single_observation_space(agent).shape[0], envs.single_action_space(agent).shape[0], args
        )
        for agent in AGENTS
    }
    optimizers = {agent: torch.optim.Adam(models[agent].parameters(), lr=args.learning_rate) for agent in AGENTS}
    done = 0

    def restore(state: dict[str, Any]) -> None:
        nonlocal done
        for agent in AGENTS:
            models[agent].load_state_dict(state["models"][agent])
            optimizers[agent].load_state_dict(state["optimizers"][agent])
        done = int(state["steps"])

    if args.resume and folder.checkpoint.exists():
        read_checkpoint(folder.checkpoint, restore)
        folder.forget_after(done)
    writer = SummaryWriter(str(folder.path / "tensorboard"))
    collector = Collector(envs, args.seed + 1000 * (done // args.batch))

    def assess(steps: int) -> None:
        point = run.assess(steps, {agent: dense_layers(models[agent].actor) for agent in AGENTS})
        for name in ("success", "contact", "drop", "timeout"):
            writer.add_scalar(f"evaluation/{name}", getattr(point, name), steps)
        state = {
            "steps": steps,
            "models": {agent: models[agent].state_dict() for agent in AGENTS},
            "optimizers": {agent: optimizers[agent].state_dict() for agent in AGENTS},
        }
        write_checkpoint(folder.checkpoint, state)

    if not folder.points:
        assess(0)
    for steps in track(range(done + args.batch, args.steps + 1, args.batch), description="updates"):
        batches = collector.collect(models, args)
        for agent in AGENTS:
            with torch.no_grad():
                gain = advantages(batches[agent], models[agent].value(collector.stacked(agent)), args)
            for key, value in update(models[agent], optimizers[agent], batches[agent], gain, args).items():
                writer.add_scalar(f"{agent}/{key}", value, steps)
        if collector.finished:
            writer.add_scalar("rollout/receiver_return", np.mean(collector.finished), steps)
            collector.finished.clear()
        if run.due(steps):
            assess(steps)
        if run.over(steps):
            break
    writer.close()
    envs.close()
    print(folder.path)


if __name__ == "__main__":
    main(tyro.cli(Args))
