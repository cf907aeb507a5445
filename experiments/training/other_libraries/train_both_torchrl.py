"""Train giver and receiver together with TorchRL, by MAPPO or IPPO.

The script needs the extras `torchrl` and `plot`, and by default MuJoCo; `--physics fast` does not need it, but
is slower.

    python experiments/training/other_libraries/train_both_torchrl.py --dataset synthetic --out runs/torchrl

The script follows TorchRL's multi-agent examples: collector, generalized advantage estimation and
clipped PPO, one group per agent. By default both critics observe the features of both agents
(MAPPO; Yu et al., "The surprising effectiveness of PPO in cooperative multi-agent games", 2022),
while each actor observes its own; with `--critic own` critics do so too (IPPO). The folder gets
`giver.npz` and `receiver.npz`, which need no TorchRL, and a learning curve.
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

from handover_marl.envs.arguments import AGENTS
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.learning.adapters.torch_modules import dense_network_from_layers
from handover_marl.learning.policy_spec import DenseNetwork
from handover_marl.learning.training.arguments import PairArgs
from handover_marl.learning.training.dense_networks import make_mlp
from handover_marl.learning.training.environments import make_pair_env
from handover_marl.learning.training.training_run import TrainingRun


@dataclass(frozen=True)
class Args(PairArgs):
    """Arguments of the training of giver and receiver with TorchRL.

    Attributes:
        critic: Inputs of each critic: centralised (features of both agents, MAPPO) or own (features
            of the critic's agent, IPPO).
        entropy: Weight of the entropy bonus.
    """

    out: str = "runs/torchrl"
    critic: Literal["centralised", "own"] = "centralised"
    entropy: float = 1e-4


class ConcatenatedInputs(nn.Module):
    """Network whose input is the concatenation of the features of several agents."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self._network = network

    def forward(self, *features: torch.Tensor) -> torch.Tensor:
        outputs: torch.Tensor = self._network(torch.cat(features, -1))
        return outputs


def make_env(args: Args) -> EnvBase:
    one = functools.partial(_wrapped, args)
    # With shared buffers the main process would busy-wait and occupy a core.
    env = one() if args.num_envs == 1 else ParallelEnv(args.num_envs, one, use_buffers=False)
    sums = RewardSum(
        in_keys=[(group, "reward") for group in AGENTS],
        out_keys=[(group, "episode_reward") for group in AGENTS],
    )
    return TransformedEnv(env, sums)


def _wrapped(args: Args) -> EnvBase:
    return PettingZooWrapper(make_pair_env(args))


def make_actor(env: EnvBase, group: str, args: Args) -> ProbabilisticActor:
    n_inputs, n_outputs = (
        spec[group, key].shape[-1]
        for spec, key in ((env.observation_spec, "observation"), (env.full_action_spec, "action"))
    )
    network = nn.Sequential(
        make_mlp(n_inputs, 2 * n_outputs, args.width, 0.01), NormalParamExtractor(f"biased_softplus_{args.initial_std}")
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
    inputs = [(agent, "observation") for agent in (AGENTS if args.critic == "centralised" else (group,))]
    n_inputs = sum(env.observation_spec[key].shape[-1] for key in inputs)
    critic = TensorDictModule(
        ConcatenatedInputs(make_mlp(n_inputs, 1, args.width)), in_keys=inputs, out_keys=[(group, "state_value")]
    )
    loss = ClipPPOLoss(
        actor, critic, clip_epsilon=args.clip_range, entropy_coeff=args.entropy, normalize_advantage=True
    )
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
    loss.make_value_estimator(gamma=args.discount, lmbda=args.gae_lambda)
    return loss


def update(batch: TensorDictBase, loss: ClipPPOLoss, optimizer: torch.optim.Optimizer, args: Args) -> None:
    with torch.no_grad():
        loss.value_estimator(batch, params=loss.critic_network_params, target_params=loss.target_critic_network_params)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(args.batch_size), sampler=SamplerWithoutReplacement(), batch_size=args.minibatch_size
    )
    buffer.extend(batch.reshape(-1))
    for _ in range(args.epochs * (args.batch_size // args.minibatch_size)):
        losses = loss(buffer.sample())
        total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
        optimizer.zero_grad()
        total.backward()
        nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
        optimizer.step()


def summarize(batch: TensorDictBase, decisions: int) -> str:
    """Return a message with mean return and outcome rates of the episodes that ended in a batch.

    Args:
        batch: Transitions of the batch.
        decisions: Number of decisions so far.
    """
    ended = batch["next", "done"].flatten()
    count = max(int(ended.sum()), 1)
    returns = batch["next", "receiver", "episode_reward"].flatten()[ended].mean()
    status = batch["next", "receiver", "info", "status"].flatten()[ended].int()
    rates = (f"{flag.label} {int((status & int(flag)).bool().sum()) / count:.0%}" for flag in EpisodeStatus if flag)
    return f"{decisions} decisions, return {float(returns):.2f}, {', '.join(rates)}"


def extract_policy_networks(actors: dict[str, ProbabilisticActor]) -> dict[str, DenseNetwork]:
    """Return the network of each agent's mean actions, tanh included, by agent."""
    return {
        group: dense_network_from_layers(actor, "tanh", output="tanh", n_outputs=actor.spec[group, "action"].shape[-1])
        for group, actor in actors.items()
    }


def main(args: Args) -> TrainingRun:
    args = args.shrink_for_smoke_test()
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    run = TrainingRun(args, "other_libraries/train_both_torchrl", args.encodings)
    env = make_env(args)
    env.set_seed(args.seed)
    actors = {group: make_actor(env, group, args) for group in AGENTS}
    losses = {group: make_loss(env, group, actor, args) for group, actor in actors.items()}
    optimizers = {group: torch.optim.Adam(loss.parameters(), args.learning_rate) for group, loss in losses.items()}
    run.evaluate(0, extract_policy_networks(actors))
    collector = Collector(
        env, TensorDictSequential(*actors.values()), frames_per_batch=args.batch_size, total_frames=args.decisions
    )
    decisions = 0
    for batch in track(collector, total=args.decisions // args.batch_size, description="updates"):
        decisions += batch.numel()
        for group, loss in losses.items():
            # Episodes end for both agents at once.
            for key in ("done", "terminated"):
                batch["next", group, key] = (
                    batch["next", key].unsqueeze(-1).expand(batch["next", group, "reward"].shape)
                )
            update(batch, loss, optimizers[group], args)
        collector.update_policy_weights_()
        print(summarize(batch, decisions), flush=True)
        for group in AGENTS:
            run.rewards.add_batch(group, batch["next", group, "info"], batch["next", "done"].flatten())
        run.rewards.write_point(decisions)
        if run.evaluate_if_due(decisions, lambda: extract_policy_networks(actors)):
            break
    collector.shutdown()
    return run


if __name__ == "__main__":
    print(main(tyro.cli(Args)).folder.path)
