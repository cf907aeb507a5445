"""Train giver and receiver together by PPO in plain PyTorch: IPPO, or MAPPO with `--critic both`.

    python experiments/training/train_both_ppo.py --data-dir DIR --seed 0 --out runs/both0

The giver chooses the pose in which it holds out the object; the receiver corrects the approach to a grasp and chooses
when to close the gripper. Both get the reward of a success. In MAPPO (Yu et al., NeurIPS 2022) the value functions
observe the features of both agents. The folder gets `giver.npz` and `receiver.npz`. Agents of several seeds are
compared with partners that they never met by

    handover-marl crossplay --givers learned:runs/both0/giver.npz,learned:runs/both1/giver.npz \
        --receivers learned:runs/both0/receiver.npz,learned:runs/both1/receiver.npz --split val
"""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from gymnasium.spaces import flatdim
from torch.distributions import Normal
from train_receiver_ppo import ActorCritic, Batch, compute_advantages, update

import handover_marl
from handover_marl.envs.arguments import AGENTS
from handover_marl.learning.adapters.modules import dense_network_from_module
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import PolicySpec
from handover_marl.learning.training.run_folder import describe_origin, make_mlp, print_validation, spawn_seeds
from handover_marl.learning.training.scene_arguments import RlArgs, run_script

#: Names of the features that each agent observes, and of the action scheme that decodes its outputs.
FEATURES = {"giver": "giver", "receiver": "close"}
SCHEMES = {"giver": "offer", "receiver": "grasp_servo"}


@dataclass(frozen=True)
class Args(RlArgs):
    """Arguments of the training of giver and receiver by PPO.

    Attributes:
        out: Folder of `giver.npz` and `receiver.npz`.
        critic: Features that an agent's value function observes: "own", or "both" for those of both agents.
        workers: Number of processes that simulate the environments.
        gripper_initial_std: Initial standard deviation of the output that closes the gripper.
        val_physics: Physics of the final evaluation: fast, exact or mujoco.
    """

    out: Path = Path("runs/both")
    critic: Literal["own", "both"] = "own"
    decisions: int = 1_000_000
    workers: int = 2
    num_envs: int = 128
    batch_size: int = 2_048
    minibatch_size: int = 256
    discount: float = 0.9
    width: int = 64
    initial_std: float = 0.15
    gripper_initial_std: float = 0.45
    val_physics: str = "mujoco"


class Learner(ActorCritic):
    """Policy that observes the first of the features only, and a value function that observes all of them.

    Args:
        n_inputs: Number of features of the policy.
        n_features: Number of features of the value function.
        stds: Initial standard deviations of the outputs.
        width: Width of the hidden layers.
    """

    def __init__(self, n_inputs: int, n_features: int, stds: list[float], width: int) -> None:
        super().__init__(n_features, len(stds), stds, width)
        self._n_inputs, self.actor = n_inputs, make_mlp(n_inputs, len(stds), width, 0.01)

    def compute_distribution(self, features: torch.Tensor) -> Normal:
        return super().compute_distribution(features[..., : self._n_inputs])


class Collector:
    """Collector of the decisions of both agents in environments of a process."""

    def __init__(self, number: int, args: Args) -> None:
        self.args, count = args, args.num_envs // args.workers
        self.envs = handover_marl.vector_env(
            count,
            None,
            features=FEATURES,
            action_scheme=SCHEMES,
            autoreset="same_step",
            processes=1,
            **args.env_options,
        )
        noise_seed, *seeds = spawn_seeds(1 + count, args.seed, number)
        self.generator = torch.Generator().manual_seed(noise_seed)
        self.features = self.join(self.envs.reset(seed=seeds)[0])
        self.outcomes: list[bool] = []

    def join(self, observations: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
        """Return each agent's features, with those of the other agent behind them if the critic observes both."""
        own = {agent: torch.as_tensor(observations[agent]) for agent in AGENTS}
        if self.args.critic == "own":
            return own
        return {
            agent: torch.cat([own[agent], *(own[other] for other in AGENTS if other != agent)], -1) for agent in own
        }

    @torch.no_grad()
    def collect(self, learners: dict[str, Learner]) -> dict[str, Batch]:
        """Take steps for one update; return each agent's decisions, and keep the outcomes of episodes that ended."""
        self.outcomes = []
        steps = [self._step(learners) for _ in range(self.args.batch_size // self.args.num_envs)]
        batches = {}
        for agent, learner in learners.items():
            parts = map(torch.stack, zip(*(step[agent] for step in steps), strict=True))
            features, actions, log_probs, values, rewards, continues = parts
            last_values = learner.compute_value(self.features[agent])
            advantages = compute_advantages(rewards, values, continues, last_values, self.args)
            batches[agent] = Batch(features, actions, log_probs, advantages, advantages + values)
        return batches

    def _step(self, learners: dict[str, Learner]) -> dict[str, tuple[torch.Tensor, ...]]:
        features, policies = self.features, {}
        for agent, learner in learners.items():
            policies[agent] = learner.compute_distribution(features[agent])
        noise = {agent: torch.randn(policy.mean.shape, generator=self.generator) for agent, policy in policies.items()}
        actions = {agent: policy.mean + policy.stddev * noise[agent] for agent, policy in policies.items()}
        found, rewards, terminated, truncated, infos = self.envs.step({a: own.numpy() for a, own in actions.items()})
        ended = terminated["receiver"] | truncated["receiver"]
        for number in np.flatnonzero(ended).tolist():
            status = int(infos["receiver"]["final_info"]["status"][number])
            self.outcomes.append(status == handover_marl.EpisodeStatus.SUCCESS)
            if not terminated["receiver"][number]:
                # The value of the last state stands for the rewards after the truncation.
                last = self.join({agent: infos[agent]["final_obs"][number] for agent in AGENTS})
                for agent, learner in learners.items():
                    rewards[agent][number] += self.args.discount * learner.compute_value(last[agent]).item()
        self.features, continues = self.join(found), torch.as_tensor(~ended).float()
        return {
            agent: (
                features[agent],
                actions[agent],
                policies[agent].log_prob(actions[agent]).sum(-1),
                learner.compute_value(features[agent]),
                torch.as_tensor(rewards[agent]).float(),
                continues,
            )
            for agent, learner in learners.items()
        }


def train(args: Args) -> dict[str, Learner]:
    """Train both agents until the number of decisions is reached, and return their networks."""
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)  # The networks are small, and the other cores simulate.
    with ThreadPoolExecutor(args.workers) as pool:
        collectors = list(pool.map(lambda number: Collector(number, args), range(args.workers)))
        envs, learners, decisions, started = collectors[0].envs, {}, 0, time.monotonic()
        for agent in AGENTS:
            stds = [args.initial_std] * envs.single_action_space(agent).shape[0]
            # Random closing succeeds now and then, so the gripper's output is explored more than the motion.
            stds[-1] = args.gripper_initial_std if agent == "receiver" else args.initial_std
            n_inputs = flatdim(envs.single_observation_space(agent))
            learners[agent] = Learner(n_inputs, collectors[0].features[agent].shape[-1], stds, args.width)
        optimizers = {agent: torch.optim.Adam(own.parameters(), args.learning_rate) for agent, own in learners.items()}
        while decisions < args.decisions:
            found = list(pool.map(lambda collector: collector.collect(learners), collectors))
            for agent, learner in learners.items():
                parts = zip(*(batches[agent] for batches in found), strict=True)
                update(learner, optimizers[agent], Batch(*(torch.cat(part, dim=1) for part in parts)), args)
            decisions += args.batch_size
            outcomes = [outcome for collector in collectors for outcome in collector.outcomes]
            print(
                f"{decisions} decisions of each agent, {decisions / (time.monotonic() - started):.0f} decisions/s: "
                f"success of {len(outcomes)} training episodes {sum(outcomes) / max(1, len(outcomes)):.1%}",
                flush=True,
            )
    for collector in collectors:
        collector.envs.close()
    return learners


def main(args: Args) -> Path:
    args = args.resolve_setup()
    args.out.mkdir(parents=True, exist_ok=True)
    origin = describe_origin("train_both_ppo", args)
    for agent, learner in train(args).items():
        spec = PolicySpec(agent, FEATURES[agent], SCHEMES[agent], args.control_period, origin)
        write_policy(args.out / f"{agent}.npz", spec, dense_network_from_module(learner.actor, "tanh"))
    giver, receiver = (f"learned:{args.out / agent}.npz" for agent in AGENTS)
    print_validation(args, args.val_scenes, args.val_physics, giver, receiver, f"{args.setup} val")
    return args.out


if __name__ == "__main__":
    print(run_script(main, Args, __doc__))
