"""Train giver and receiver at once with TorchRL: collector, GAE and clipped PPO, a group an agent. Needs `torchrl`.

    python experiments/train_both_torchrl.py --data-dir DIR --frames 100000

In the form of TorchRL's own multi-agent examples: what is particular to handovers is one line, the environment. Prints
a line an update: frames so far, mean return of finished episodes, and how they ended.
"""

from dataclasses import dataclass

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import PettingZooWrapper, RewardSum, TransformedEnv
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

import handover_marl
from handover_marl.protocol.status import EpisodeStatus


@dataclass(frozen=True)
class Args:
    """What to train on, and how long.

    Attributes:
        frames: Decisions in all.
        batch: Decisions between updates.
        minibatch: Decisions a gradient step looks at.
        epochs: Passes over a batch.
        learning_rate: Of Adam.
        discount: Of rewards.
        setup: Official setup, s0 to s3.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        control_period: How long actions hold (s).
        max_cycles: Decisions after which episodes are cut off.
        seed: Of everything.
    """

    frames: int = 100_000
    batch: int = 2048
    minibatch: int = 256
    epochs: int = 8
    learning_rate: float = 3e-4
    discount: float = 0.97
    setup: str = "s0"
    data_dir: str | None = None
    dataset: str = "auto"
    control_period: float = 0.2
    max_cycles: int = 40
    seed: int = 0


def make_env(args: Args) -> TransformedEnv:
    world = handover_marl.parallel_env(
        setup=args.setup,
        split="train",
        data_dir=args.data_dir,
        dataset=args.dataset,
        physics="fast",
        rewards="shaped",
        control_period=args.control_period,
        max_cycles=args.max_cycles,
    )
    env = PettingZooWrapper(handover_marl.encode(world, schemes={"receiver": "grasp_servo"}))
    sums = RewardSum(
        in_keys=[(group, "reward") for group in env.group_map],
        out_keys=[(group, "episode_reward") for group in env.group_map],
    )
    return TransformedEnv(env, sums)


def mlp(n_inputs: int, n_outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, n_outputs))


def make_actor(env: TransformedEnv, group: str) -> ProbabilisticActor:
    seen, outputs = (
        spec[group, key] for spec, key in ((env.observation_spec, "observation"), (env.action_spec, "action"))
    )
    network = nn.Sequential(mlp(seen.shape[-1], 2 * outputs.shape[-1]), NormalParamExtractor())
    means = TensorDictModule(network, in_keys=[(group, "observation")], out_keys=[(group, "loc"), (group, "scale")])
    return ProbabilisticActor(
        means,
        spec=env.full_action_spec[group, "action"],
        in_keys=[(group, "loc"), (group, "scale")],
        out_keys=[(group, "action")],
        distribution_class=TanhNormal,
        return_log_prob=True,
        log_prob_key=(group, "log_prob"),
    )


def make_loss(env: TransformedEnv, group: str, actor: ProbabilisticActor, args: Args) -> ClipPPOLoss:
    seen = env.observation_spec[group, "observation"]
    critic = TensorDictModule(
        mlp(seen.shape[-1], 1), in_keys=[(group, "observation")], out_keys=[(group, "state_value")]
    )
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=1e-4, normalize_advantage=True)
    loss.set_keys(
        reward=(group, "reward"),
        action=(group, "action"),
        sample_log_prob=(group, "log_prob"),
        value=(group, "state_value"),
        done=(group, "done"),
        terminated=(group, "terminated"),
        advantage=(group, "advantage"),
        value_target=(group, "value_target"),
    )
    loss.make_value_estimator(gamma=args.discount, lmbda=0.95)
    return loss


def update(batch: TensorDictBase, loss: ClipPPOLoss, optimizer: torch.optim.Optimizer, args: Args) -> None:
    with torch.no_grad():
        loss.value_estimator(batch, params=loss.critic_network_params, target_params=loss.target_critic_network_params)
    memory = ReplayBuffer(
        storage=LazyTensorStorage(args.batch), sampler=SamplerWithoutReplacement(), batch_size=args.minibatch
    )
    memory.extend(batch.reshape(-1))
    for _ in range(args.epochs * (args.batch // args.minibatch)):
        parts = loss(memory.sample())
        total = parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]
        optimizer.zero_grad()
        total.backward()
        nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
        optimizer.step()


def told(batch: TensorDictBase, frames: int) -> str:
    """How the episodes that ended in a batch went."""
    ended = batch["next", "done"].squeeze(-1)
    count = max(int(ended.sum()), 1)
    returns = batch["next", "receiver", "episode_reward"].flatten(1)[ended.flatten()].mean()
    status = batch["next", "receiver", "info", "status"].flatten(1)[ended.flatten()].int()
    rates = (f"{flag.label} {int((status & int(flag)).bool().sum()) / count:.0%}" for flag in EpisodeStatus if flag)
    return f"{frames} decisions, return {float(returns):.2f}, {', '.join(rates)}"


def main(args: Args) -> None:
    torch.manual_seed(args.seed)
    env = make_env(args)
    env.set_seed(args.seed)
    actors = {group: make_actor(env, group) for group in env.group_map}
    losses = {group: make_loss(env, group, actor, args) for group, actor in actors.items()}
    optimizers = {group: torch.optim.Adam(loss.parameters(), args.learning_rate) for group, loss in losses.items()}
    collector = Collector(
        env,
        TensorDictSequential(*actors.values()),
        frames_per_batch=args.batch,
        total_frames=args.frames,
    )
    frames = 0
    for batch in collector:
        frames += batch.numel()
        for group, loss in losses.items():
            # The end of an episode is everybody's.
            for key in ("done", "terminated"):
                batch["next", group, key] = (
                    batch["next", key].unsqueeze(-1).expand(batch["next", group, "reward"].shape)
                )
            update(batch, loss, optimizers[group], args)
        collector.update_policy_weights_()
        print(told(batch, frames), flush=True)
    collector.shutdown()


if __name__ == "__main__":
    main(tyro.cli(Args))
