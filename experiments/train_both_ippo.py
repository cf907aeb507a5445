"""Train giver and receiver at once by independent PPO: plain PyTorch and a PettingZoo loop. Needs `train`, `plot`.

    python experiments/train_both_ippo.py --data-dir DIR --out runs/both

Each agent has a network of its own and takes the other for a part of the world (de Witt et al., "Is independent
learning all you need in the StarCraft multi-agent challenge?", 2020). The folder gets `giver.npz` and
`receiver.npz` (`--givers learned:runs/both/giver.npz`), a learning curve, TensorBoard logs, and a checkpoint:
`--resume` goes on where a run was stopped.
"""

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.progress import track
from torch import nn
from torch.utils.tensorboard import SummaryWriter

from handover_marl.benchmarking.runner import evaluate_pair
from handover_marl.datasets import open_dataset
from handover_marl.envs.constructors import parallel_env
from handover_marl.envs.encode import FEATURES, SCHEMES, EncodedEnv, encode
from handover_marl.envs.rewards import SHAPED
from handover_marl.learning.network import Network
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import PolicySpec
from handover_marl.training.checkpoint import read_checkpoint, write_checkpoint
from handover_marl.training.learning_curve import CurvePoint
from handover_marl.training.run_folder import RunFolder, origin, spread_scenes, training_scenes
from handover_marl.training.training_args import TrainingArgs

AGENTS = ("giver", "receiver")
OBSERVE = FEATURES | {"receiver": "grasp"}


@dataclass(frozen=True)
class Args(TrainingArgs):
    """What to train, and how. Environments are stepped one after the other in this process.

    Attributes:
        rollout: Decisions in each environment between updates.
        minibatches: Parts of a rollout.
        clip: PPO's clipping range.
        entropy: Weight of the entropy bonus.
        every: Updates between evaluations.
    """

    out: str = "runs/both"
    control_period: float = 0.2
    time_limit: float = 8.0
    steps: int = 300_000
    discount: float = 0.96
    rollout: int = 128
    minibatches: int = 8
    clip: float = 0.2
    entropy: float = 0.0
    every: int = 20


class ActorCritic(nn.Module):
    """A Gaussian policy and a value, two hidden layers each."""

    def __init__(self, n_inputs: int, n_outputs: int, spread: float) -> None:
        super().__init__()
        self.actor = layers(n_inputs, n_outputs, 0.01)
        self.critic = layers(n_inputs, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((n_outputs,), float(np.log(spread))))

    def distribution(self, seen: torch.Tensor) -> torch.distributions.Normal:
        return torch.distributions.Normal(self.actor(seen), self.log_std.exp())

    def value(self, seen: torch.Tensor) -> torch.Tensor:
        return self.critic(seen).squeeze(-1)


def layers(n_inputs: int, n_outputs: int, gain: float) -> nn.Sequential:
    parts = [nn.Linear(n_inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, n_outputs)]
    for part in parts:
        if isinstance(part, nn.Linear):
            nn.init.orthogonal_(part.weight, gain if part is parts[-1] else np.sqrt(2.0))
            nn.init.zeros_(part.bias)
    return nn.Sequential(*parts)


class Collector:
    """Steps some PettingZoo environments and keeps what both agents saw, did and got."""

    def __init__(self, envs: list[EncodedEnv], seed: int) -> None:
        self.envs = envs
        self.seen = [env.reset(seed + number)[0] for number, env in enumerate(envs)]
        self.finished: list[float] = []
        self._returns = np.zeros(len(envs))

    def collect(self, models: dict[str, ActorCritic], args: Args) -> dict[str, dict[str, torch.Tensor]]:
        steps: list[dict[str, dict[str, np.ndarray]]] = []
        for _ in range(args.rollout):
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
        for part in torch.randperm(len(gain)).chunk(args.minibatches):
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


def export(model: ActorCritic, agent: str, args: Args, path: Path) -> None:
    dense = [part for part in model.actor if isinstance(part, nn.Linear)]
    network = Network(
        tuple(part.weight.detach().numpy().copy() for part in dense),
        tuple(part.bias.detach().numpy().copy() for part in dense),
    )
    write_policy(
        path,
        PolicySpec(agent, OBSERVE[agent], SCHEMES[agent], args.control_period, origin("train_both_ippo", args)),
        network,
    )


def main(args: Args) -> None:
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    data = open_dataset(args.dataset, args.data_dir)
    folder = RunFolder(Path(args.out), args, args.resume, data.name)
    common = {"setup": args.setup, "data_dir": args.data_dir, "dataset": args.dataset, "physics": args.physics}
    scenes = training_scenes(data.split(args.setup, "train"))
    val = spread_scenes(data.split(args.setup, "val"), args.val_scenes)
    options = common | {
        "control_period": args.control_period,
        "rewards": replace(SHAPED, gamma=args.discount),
        "split": "train",
        "scenes": scenes,
        "max_cycles": math.ceil(args.time_limit / args.control_period),
    }
    envs = [encode(parallel_env(**options), OBSERVE) for _ in range(args.envs)]
    models = {
        agent: ActorCritic(envs[0].observation_space(agent).shape[0], envs[0].action_space(agent).shape[0], args.spread)
        for agent in AGENTS
    }
    optimizers = {agent: torch.optim.Adam(models[agent].parameters(), lr=args.learning_rate) for agent in AGENTS}
    done = 0

    def restore(state: dict[str, Any]) -> None:
        nonlocal done
        for agent in AGENTS:
            models[agent].load_state_dict(state["models"][agent])
            optimizers[agent].load_state_dict(state["optimizers"][agent])
        done = int(state["updates"])

    if args.resume and folder.checkpoint.exists():
        read_checkpoint(folder.checkpoint, restore)
    writer = SummaryWriter(str(folder.path / "tensorboard"))
    collector = Collector(envs, args.seed + 1000 * done)
    before, started = folder.seconds, time.monotonic()

    def assess(updates: int) -> None:
        for agent in AGENTS:
            export(models[agent], agent, args, folder.path / f"{agent}.npz")
        names = [f"learned:{folder.path / agent}.npz" for agent in AGENTS]
        report = evaluate_pair(names[0], names[1], split="val", scenes=val, progress=False, **common)
        seconds = before + time.monotonic() - started
        point = CurvePoint.of(report, updates * args.envs * args.rollout, seconds, "each other")
        folder.add(point)
        for name in ("success", "contact", "drop", "timeout"):
            writer.add_scalar(f"evaluation/{name}", getattr(point, name), point.steps)
        state = {
            "updates": updates,
            "models": {agent: models[agent].state_dict() for agent in AGENTS},
            "optimizers": {agent: optimizers[agent].state_dict() for agent in AGENTS},
        }
        write_checkpoint(folder.checkpoint, state)

    updates = args.steps // (args.envs * args.rollout)
    for number in track(range(done, updates), description="updates"):
        if number % args.every == 0 and (number > done or not folder.points):
            assess(number)
        if before + time.monotonic() - started > 60.0 * args.minutes:
            break
        batches = collector.collect(models, args)
        for agent in AGENTS:
            with torch.no_grad():
                gain = advantages(batches[agent], models[agent].value(collector.stacked(agent)), args)
            for key, value in update(models[agent], optimizers[agent], batches[agent], gain, args).items():
                writer.add_scalar(f"{agent}/{key}", value, number)
        if collector.finished:
            writer.add_scalar("rollout/receiver_return", np.mean(collector.finished), number)
            collector.finished.clear()
        done = number + 1
    assess(done)
    writer.close()
    for env in envs:
        env.close()
    print(folder.path)


if __name__ == "__main__":
    main(tyro.cli(Args))
