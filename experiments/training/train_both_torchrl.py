"""Train giver and receiver together with TorchRL by MAPPO: both critics observe the features of both agents.

    python experiments/training/train_both_torchrl.py --dataset synthetic --out runs/torchrl

The loop follows TorchRL's multi-agent examples. It needs the extra `torchrl`.
"""

import torch
from pair import PairArgs, make_env, write_pair
from rich.progress import track
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ParallelEnv, PettingZooWrapper
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

from handover_marl.envs.arguments import AGENTS
from handover_marl.learning.adapters.modules import dense_network_from_layers
from handover_marl.learning.training.run_folder import make_mlp
from handover_marl.learning.training.scene_arguments import run_script


def make_loss(env: EnvBase, agent: str, args: PairArgs) -> ClipPPOLoss:
    """Make PPO's loss of an agent, with its actor and its critic, which observes the features of both agents."""
    sizes = {each: env.observation_spec[each, "observation"].shape[-1] for each in AGENTS}
    spec = env.full_action_spec[agent, "action"]
    outputs = NormalParamExtractor(f"biased_softplus_{args.initial_std}")
    network = nn.Sequential(make_mlp(sizes[agent], 2 * spec.shape[-1], args.width, 0.01), outputs)
    layers = TensorDictModule(network, [(agent, "observation")], [(agent, "loc"), (agent, "scale")])
    keys = {"in_keys": layers.out_keys, "out_keys": [(agent, "action")], "log_prob_key": (agent, "log_prob")}
    actor = ProbabilisticActor(layers, spec=spec, distribution_class=TanhNormal, return_log_prob=True, **keys)
    inputs = [(each, "observation") for each in AGENTS]
    both = TensorDictModule(lambda *parts: torch.cat(parts, -1), in_keys=inputs, out_keys=["both"])
    values = make_mlp(sum(sizes.values()), 1, args.width)
    critic = TensorDictSequential(both, TensorDictModule(values, in_keys=["both"], out_keys=[(agent, "state_value")]))
    loss = ClipPPOLoss(actor, critic, clip_epsilon=args.clip_range, entropy_coeff=1e-4, normalize_advantage=True)
    names = ("reward", "action", "done", "terminated", "advantage", "value_target")
    loss.set_keys(sample_log_prob=(agent, "log_prob"), value=(agent, "state_value"))
    loss.set_keys(**{name: (agent, name) for name in names})
    loss.make_value_estimator(gamma=args.discount, lmbda=args.gae_lambda)
    return loss


def main(args: PairArgs) -> None:
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    # With shared buffers the main process would busy-wait and occupy a core.
    env = ParallelEnv(args.num_envs, lambda: PettingZooWrapper(make_env(args)), use_buffers=False)
    env.set_seed(args.seed)
    losses = {agent: make_loss(env, agent, args) for agent in AGENTS}
    optimizers = {agent: torch.optim.Adam(loss.parameters(), args.learning_rate) for agent, loss in losses.items()}
    actors = {agent: loss.actor_network for agent, loss in losses.items()}
    policy = TensorDictSequential(*actors.values())
    collector = Collector(env, policy, frames_per_batch=args.batch_size, total_frames=args.decisions)
    for batch in track(collector, total=args.decisions // args.batch_size, description="updates"):
        for agent, loss in losses.items():
            for key in ("done", "terminated"):  # episodes end for both agents at once
                shape = batch["next", agent, "reward"].shape
                batch["next", agent, key] = batch["next", key].unsqueeze(-1).expand(shape)
            with torch.no_grad():
                parameters = {"params": loss.critic_network_params, "target_params": loss.target_critic_network_params}
                loss.value_estimator(batch, **parameters)
            rows = batch.reshape(-1)
            for _ in range(args.epochs):
                for numbers in torch.randperm(len(rows)).split(args.minibatch_size):
                    found = loss(rows[numbers])
                    optimizers[agent].zero_grad()
                    (found["loss_objective"] + found["loss_critic"] + found["loss_entropy"]).backward()
                    nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                    optimizers[agent].step()
        collector.update_policy_weights_()
    sizes = {agent: env.full_action_spec[agent, "action"].shape[-1] for agent in AGENTS}
    networks = {agent: dense_network_from_layers(net, "tanh", "tanh", sizes[agent]) for agent, net in actors.items()}
    collector.shutdown()
    write_pair(networks, args, "train_both_torchrl")


if __name__ == "__main__":
    run_script(main, PairArgs)
