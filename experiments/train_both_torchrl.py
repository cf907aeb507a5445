"""Train giver and receiver at once with TorchRL, by MAPPO or IPPO.

Needs the extras `torchrl`, `plot` and, for its default, `mujoco`; or `--physics fast`, slower.

    python experiments/train_both_torchrl.py --dataset synthetic --out runs/torchrl

In the form of TorchRL's own multi-agent examples: collector, GAE and clipped PPO, a group an agent. By default both
critics see what both agents see (MAPPO; Yu et al., "The surprising effectiveness of PPO in cooperative multi-agent
games", 2022), while each actor has its own features alone; with `--critic own` every agent learns for itself (IPPO).
The folder gets `giver.npz` and `receiver.npz`, which need no TorchRL, and a learning curve.
"""

import functools
from dataclasses import dataclass
from typing import Literal

import torch
import tyro
from rich.progress import track
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import EnvBase, ParallelEnv, PettingZooWrapper, RewardSum, TransformedEnv
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

from handover_marl.learning.network import Network
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.training.dense_layers import dense_layers, mlp
from handover_marl.training.pair_run import PairArgs, PairRun, pair_env

AGENTS = ("giver", "receiver")


@dataclass(frozen=True)
class Args(PairArgs):
    """What to train, and how.

    Attributes:
        critic: What critics see: centralised, both agents' features (MAPPO), or own (IPPO).
        entropy: Weight of the entropy bonus.
    """

    out: str = "runs/torchrl"
    critic: Literal["centralised", "own"] = "centralised"
    entropy: float = 1e-4


class Joint(nn.Sequential):
    """Layers that see several agents' features side by side."""

    def forward(self, *seen: torch.Tensor) -> torch.Tensor:
        return super().forward(torch.cat(seen, -1))


def make_env(args: Args) -> EnvBase:
    one = functools.partial(_wrapped, args)
    # Without shared buffers it sleeps while it waits for the processes; with them it would take a core from them.
    env = one() if args.envs == 1 else ParallelEnv(args.envs, one, use_buffers=False)
    sums = RewardSum(
        in_keys=[(group, "reward") for group in AGENTS],
        out_keys=[(group, "episode_reward") for group in AGENTS],
    )
    return TransformedEnv(env, sums)


def _wrapped(args: Args) -> EnvBase:
    return PettingZooWrapper(pair_env(args))


def make_actor(env: EnvBase, group: str, args: Args) -> ProbabilisticActor:
    seen, outputs = (
        spec[group, key].shape[-1]
        for spec, key in ((env.observation_spec, "observation"), (env.full_action_spec, "action"))
    )
    network = nn.Sequential(
        mlp(seen, 2 * outputs, args.width, 0.01), NormalParamExtractor(f"biased_softplus_{args.spread}")
    )
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


def make_loss(env: EnvBase, group: str, actor: ProbabilisticActor, args: Args) -> ClipPPOLoss:
    shown = [(agent, "observation") for agent in (AGENTS if args.critic == "centralised" else (group,))]
    n_inputs = sum(env.observation_spec[key].shape[-1] for key in shown)
    critic = TensorDictModule(Joint(mlp(n_inputs, 1, args.width)), in_keys=shown, out_keys=[(group, "state_value")])
    loss = ClipPPOLoss(actor, critic, clip_epsilon=args.clip, entropy_coeff=args.entropy, normalize_advantage=True)
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
    loss.make_value_estimator(gamma=args.discount, lmbda=args.trace)
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
    ended = batch["next", "done"].flatten()
    count = max(int(ended.sum()), 1)
    returns = batch["next", "receiver", "episode_reward"].flatten()[ended].mean()
    status = batch["next", "receiver", "info", "status"].flatten()[ended].int()
    rates = (f"{flag.label} {int((status & int(flag)).bool().sum()) / count:.0%}" for flag in EpisodeStatus if flag)
    return f"{frames} decisions, return {float(returns):.2f}, {', '.join(rates)}"


def networks(actors: dict[str, ProbabilisticActor]) -> dict[str, Network]:
    """What the actors do without noise: the squashed means."""
    return {
        group: dense_layers(actor, "tanh", actor.spec[group, "action"].shape[-1]) for group, actor in actors.items()
    }


def main(args: Args) -> PairRun:
    args = args.sized()
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    run = PairRun(args, "train_both_torchrl")
    env = make_env(args)
    env.set_seed(args.seed)
    actors = {group: make_actor(env, group, args) for group in AGENTS}
    losses = {group: make_loss(env, group, actor, args) for group, actor in actors.items()}
    optimizers = {group: torch.optim.Adam(loss.parameters(), args.learning_rate) for group, loss in losses.items()}
    run.assess(0, networks(actors))
    collector = Collector(
        env, TensorDictSequential(*actors.values()), frames_per_batch=args.batch, total_frames=args.steps
    )
    frames = 0
    for batch in track(collector, total=args.steps // args.batch, description="updates"):
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
        if run.due(frames):
            run.assess(frames, networks(actors))
        if run.over(frames):
            break
    collector.shutdown()
    return run


if __name__ == "__main__":
    print(main(tyro.cli(Args)).folder.path)
