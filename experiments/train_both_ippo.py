"""Train giver and receiver at once by independent PPO: plain PyTorch and a PettingZoo loop. Needs `train`, `plot`.

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

from handover_marl.envs.encode import EncodedEnv
from handover_marl.training.checkpoint import read_checkpoint, write_checkpoint
from handover_marl.training.dense_layers import dense_layers, mlp
from handover_marl.training.pair_run import PairArgs, PairRun, pair_env
from handover_marl.training.training_args import TrainingArgs

AGENTS = ("giver", "receiver")


@dataclass(frozen=True)
class Args(PairArgs, TrainingArgs):
    """What to train, and how. Environments are stepped one after the other in this process.

    Attributes:
        entropy: Weight of the entropy bonus.
    """

    out: str = "runs/both"
    time_limit: float = 8.0
    steps: int = 300_000
    minutes: float = 60.0
    envs: int = 8
    learning_rate: float = 3e-4
    discount: float = 0.96
    spread: float = 0.5
    val_scenes: int = 36
    giver_actions: str = "deviation"
    receiver_observe: str = "grasp"
    receiver_actions: str = "cartesian_delta"
    rewards: str = "shaped"
    batch: int = 1024
    every: int = 20_480
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
    """Steps some PettingZoo environments and keeps what both agents saw, did and got."""

    def __init__(self, envs: list[EncodedEnv], seed: int) -> None:
        self.envs = envs
        self.seen = [env.reset(seed + number)[0] for number, env in enumerate(envs)]
        self.finished: list[float] = []
        self._returns = np.zeros(len(envs))

    def collect(self, models: dict[str, ActorCritic], args: Args) -> dict[str, dict[str, torch.Tensor]]:
        steps: list[dict[str, dict[str, np.ndarray]]] = []
        for _ in range(args.batch // args.envs):
            now = self._act(models)
            self._step(now, models, args.discount)
            steps.append(now)
        return {
            agent: {key: torch.as_tensor(np.stack([step[agent][key] for step in steps])) for key in steps[0][agent]}
            for agent in AGENTS
        }

    def stacked(self, agent: str) -> torch.Tensor:
        return torch.as_tensor(np.stack([seen[agent] for seen in self.seen]))

    def _act(self, models: dict[str, ActorCritic]) -> dict[str, dict[str, np.ndarray]]:
        now = {}
        for agent, model in models.items():
            seen = self.stacked(agent)
            with torch.no_grad():
                distribution = model.distribution(seen)
                action = distribution.sample()
                log = distribution.log_prob(action).sum(-1)
                parts = {"seen": seen, "action": action, "log": log, "value": model.value(seen)}
            now[agent] = {key: value.numpy() for key, value in parts.items()}
            now[agent] |= {key: np.zeros(len(self.envs), np.float32) for key in ("reward", "end")}
        return now

    def _step(self, now: dict[str, dict[str, np.ndarray]], models: dict[str, ActorCritic], discount: float) -> None:
        for number, env in enumerate(self.envs):
            actions = {agent: now[agent]["action"][number] for agent in AGENTS}
            seen, rewards, ended, _, _ = env.step(actions)
            self._returns[number] += rewards["receiver"]
            for agent in AGENTS:
                reward = rewards[agent]
                if not env.agents and not ended[agent]:
                    # Cut off, not over: what would have come counts.
                    with torch.no_grad():
                        reward += discount * float(models[agent].value(torch.as_tensor(seen[agent])))
                now[agent]["reward"][number] = reward
                now[agent]["end"][number] = not env.agents
            if not env.agents:
                self.finished.append(float(self._returns[number]))
                self._returns[number] = 0.0
                seen, _ = env.reset()
            self.seen[number] = seen


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
    return {"value_loss": float(missed), "std": float(model.log_std.exp().mean())}


def main(args: Args) -> None:
    args = args.sized()
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    run = PairRun(args, "train_both_ippo")
    folder = run.folder
    envs = [pair_env(args) for _ in range(args.envs)]
    models = {
        agent: ActorCritic(envs[0].observation_space(agent).shape[0], envs[0].action_space(agent).shape[0], args)
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
    for env in envs:
        env.close()
    print(folder.path)


if __name__ == "__main__":
    main(tyro.cli(Args))
