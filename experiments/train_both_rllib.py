"""Train giver and receiver at once with RLlib's PPO on its new API stack.

Needs the extras `rllib`, `plot` and, for its default, `mujoco`; or `--physics fast`, slower.

    python experiments/train_both_rllib.py --dataset synthetic --out runs/rllib

Two RLModules, one an agent, whose spaces differ; EnvRunners in processes of their own, the default connectors between
them and the modules. RLlib's modules take vectors, as `encode` makes them here; for other observations there is
`handover_marl.flatten`. The folder gets `giver.npz` and `receiver.npz`, which need no Ray, and a learning curve.
"""

import math
from dataclasses import dataclass
from typing import Any

import ray
import torch
import tyro
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env
from rich.progress import track
from torch import nn

from handover_marl.learning.network import Network
from handover_marl.training.dense_layers import dense_layers, mlp
from handover_marl.training.pair_run import PairArgs, PairRun, pair_env

AGENTS = ("giver", "receiver")
_OBJECT_STORE = 200_000_000  # bytes
_PATIENCE = 3600.0  # s


@dataclass(frozen=True)
class Args(PairArgs):
    """What to train, and how. With one environment it is stepped in this process, else each in its own."""

    out: str = "runs/rllib"


class ActorCritic(TorchRLModule, ValueFunctionAPI):
    """A Gaussian policy whose spread is learned for all states together, and a value beside it."""

    def setup(self) -> None:
        n_inputs, n_outputs = self.observation_space.shape[0], self.action_space.shape[0]
        self.actor = mlp(n_inputs, n_outputs, self.model_config["width"], 0.01)
        self.critic = mlp(n_inputs, 1, self.model_config["width"])
        self.log_std = nn.Parameter(torch.full((n_outputs,), math.log(self.model_config["spread"])))

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        means = self.actor(batch[Columns.OBS])
        return {Columns.ACTION_DIST_INPUTS: torch.cat([means, self.log_std.expand_as(means)], -1)}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> torch.Tensor:
        return self.critic(batch[Columns.OBS]).squeeze(-1)


def configuration(args: Args) -> PPOConfig:
    register_env("handover", lambda _: ParallelPettingZooEnv(pair_env(args)))
    module = RLModuleSpec(ActorCritic, model_config={"width": args.width, "spread": args.spread})
    return (
        PPOConfig()
        .environment("handover")
        # On a slow or busy machine a batch may take long; one that is late would be thrown away.
        .env_runners(num_env_runners=args.envs if args.envs > 1 else 0, sample_timeout_s=_PATIENCE)
        .learners(num_learners=0)
        .multi_agent(policies=set(AGENTS), policy_mapping_fn=lambda agent, episode, **_: agent)
        .rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=dict.fromkeys(AGENTS, module)))
        .training(
            train_batch_size_per_learner=args.batch,
            minibatch_size=args.minibatch,
            num_epochs=args.epochs,
            lr=args.learning_rate,
            gamma=args.discount,
            lambda_=args.trace,
            clip_param=args.clip,
            vf_loss_coeff=0.5,
            vf_clip_param=float("inf"),
            use_kl_loss=False,
            grad_clip=0.5,
        )
        .debugging(seed=args.seed, log_level="ERROR")
    )


def networks(algorithm: Algorithm) -> dict[str, Network]:
    """What the modules do without noise: the means, which action schemes clip."""
    return {agent: dense_layers(algorithm.get_module(agent).actor) for agent in AGENTS}


def told(result: dict[str, Any], steps: int) -> str:
    """How the episodes of late went."""
    returns = result.get("env_runners", {}).get("agent_episode_returns_mean", {})
    return f"{steps} decisions, " + ", ".join(f"{agent}'s return {value:.2f}" for agent, value in returns.items())


def main(args: Args) -> PairRun:
    args = args.sized()
    torch.set_num_threads(1)
    run = PairRun(args, "train_both_rllib")
    ray.init(num_cpus=args.envs + 1, object_store_memory=_OBJECT_STORE, include_dashboard=False, log_to_driver=False)
    try:
        algorithm = configuration(args).build_algo()
        run.assess(0, networks(algorithm))
        for _ in track(range(math.ceil(args.steps / args.batch)), description="updates"):
            result = algorithm.train()
            steps = int(result["num_env_steps_sampled_lifetime"])
            print(told(result, steps), flush=True)
            if run.due(steps):
                run.assess(steps, networks(algorithm))
            if run.over(steps):
                break
        algorithm.stop()
    finally:
        ray.shutdown()
    return run


if __name__ == "__main__":
    print(main(tyro.cli(Args)).folder.path)
