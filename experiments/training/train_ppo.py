"""Train one agent with a fixed partner by PPO in plain PyTorch, in one file.

    python experiments/training/train_ppo.py --data-dir DIR --out runs/ppo.npz
    python experiments/training/train_ppo.py --data-dir DIR --agent giver --out runs/giver.npz

A receiver learns when to close the gripper and how to correct the approach to a grasp (action scheme `grasp_servo`).
A giver makes one decision per episode: the pose in which it holds out the object (action scheme `offer`). Both are
rewarded for successes. `--initial FILE` trains the network of a policy file further. With a receiver from
`train_receiver_dagger.py`, which moves the gripper without a script, use a small `--learning-rate`; further training
has not raised its success rate so far.

The script needs the extra `train`, and with `--backend warp` also the extra `warp`. Warp keeps environments and
networks on one device, such as `--backend warp --device cuda --num-envs 1024`. The policy file runs without PyTorch:
`handover-marl benchmark --setup s0 --receiver learned:runs/ppo.npz`.
"""

import itertools
import math
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from both_agents import FEATURES, SCHEMES
from gymnasium.spaces import flatdim
from torch import nn
from torch.distributions import Normal

import handover_marl
from handover_marl.envs.agents import AGENTS
from handover_marl.envs.custom_rewards import set_discount
from handover_marl.errors import OptionError
from handover_marl.geometry.arrays import make_tensor_factory
from handover_marl.learning.adapters.modules import dense_network_from_layers
from handover_marl.learning.encodings.custom import is_reference
from handover_marl.learning.policy_files import DenseNetwork, PolicySpec, check_policy_path, read_policy, write_policy
from handover_marl.learning.training.run_folder import describe_origin, make_mlp, spawn_seeds, validate
from handover_marl.learning.training.scene_arguments import RlArgs, run_script
from handover_marl.simulation.engines import CPU, THREADS, WARP, BatchBackend, check_backend

_PARTNERS = {"giver": "yang2021", "receiver": "cooperative"}


@dataclass(frozen=True)
class Args(RlArgs):
    """Arguments of the training of one agent by PPO.

    Attributes:
        out: Policy file to write.
        agent: Agent that learns.
        partner: Fixed policy of the other agent, with options; default: cooperative for receivers, yang2021 for givers.
        features: Features that the agent observes; default: close for receivers, giver for givers.
        action_scheme: Action scheme of the agent; default: grasp_servo for receivers, offer for givers.
        rewards: Rewards: sparse, shaped, or module:name for own ones; see docs/reference/rewards.md.
        initial: Policy file whose network is trained further, with its features, actions and control period; None
            trains a new network.
        minutes: Largest wall-clock time of the training (min), without the evaluation.
        workers: Number of processes that simulate the environments; the result depends on it. Not used with the
            backend "warp".
        backend: Backend of the environments: "threads" for MuJoCo on the processor, or "warp" for MuJoCo Warp.
        device: Device of environments and networks with the backend "warp": cuda, or cpu for tests.
        gripper_initial_std: Initial standard deviation of the output that closes a receiver's gripper.
        val_scenes: Number of validation scenes of the final evaluation, evenly chosen; 0 skips it.
        val_physics: Physics of the final evaluation: fast, exact or mujoco.
    """

    out: Path = Path("runs/ppo.npz")
    agent: Literal["receiver", "giver"] = "receiver"
    partner: str = ""
    features: str = ""
    action_scheme: str = ""
    rewards: str = "sparse"
    initial: Path | None = None
    decisions: int = 12_288
    minutes: float = 30.0
    num_envs: int = 128
    workers: int = 2
    backend: str = THREADS
    device: str = CPU
    batch_size: int = 1_024
    minibatch_size: int = 256
    discount: float = 0.9
    width: int = 64
    initial_std: float = 0.15
    gripper_initial_std: float = 0.45
    val_physics: str = "fast"


class ActorCritic(nn.Module):
    """Gaussian policy whose standard deviation does not depend on the features, and a value function.

    Args:
        n_inputs: Number of features that the policy observes; they are the first of all features.
        stds: Initial standard deviations of the policy's outputs.
        width: Width of the hidden layers of a new network.
        initial: Network with two hidden tanh layers with which the policy starts; None: a new one.
        n_features: Number of features that the value function observes; None: `n_inputs`.
    """

    def __init__(
        self,
        n_inputs: int,
        stds: list[float],
        width: int,
        initial: DenseNetwork | None = None,
        n_features: int | None = None,
    ) -> None:
        super().__init__()
        self._n_inputs, width = n_inputs, width if initial is None else len(initial.biases[0])
        self.actor, self.critic = make_mlp(n_inputs, len(stds), width, 0.01), make_mlp(n_features or n_inputs, 1, width)
        self.normalization = None
        if initial is not None:
            self.normalization = initial.normalization
            numbers = itertools.chain(*zip(initial.weights, initial.biases, strict=True))
            for parameter, values in zip(self.actor.parameters(), numbers, strict=True):
                parameter.data.copy_(torch.as_tensor(values))
        self.log_std = nn.Parameter(torch.tensor(stds).log())

    def compute_distribution(self, features: torch.Tensor) -> Normal:
        return Normal(self.actor(self._normalize(features[..., : self._n_inputs])), self.log_std.exp())

    def compute_value(self, features: torch.Tensor) -> torch.Tensor:
        values: torch.Tensor = self.critic(self._normalize(features))
        return values[..., 0]

    def _normalize(self, features: torch.Tensor) -> torch.Tensor:
        return features if self.normalization is None else self.normalization(features)


class Batch(NamedTuple):
    """Decisions of n environments in k steps, with advantages and targets of the values: tensors (k, n, ...)."""

    features: torch.Tensor
    actions: torch.Tensor
    log_probs: torch.Tensor
    advantages: torch.Tensor
    targets: torch.Tensor


class Collector:
    """Collector of the decisions of one or both agents in the environments of one process.

    Episodes continue from one rollout to the next.

    Args:
        number: Number of the collector, part of the seed of its random numbers.
        args: Arguments of the training.
        agents: Agents that learn.
        envs: Vector environment of these agents.
        sees_both: Whether the value function of an agent observes the features of both agents, its own first.
        device: Device of environments and networks.
    """

    def __init__(
        self, number: int, args: RlArgs, agents: tuple[str, ...], envs: Any, sees_both: bool, device: str
    ) -> None:
        self.args, self.agents, self.envs, self.sees_both, self.device = args, agents, envs, sees_both, device
        noise_seed, *seeds = spawn_seeds(1 + envs.num_envs, args.seed, number)
        self.generator = torch.Generator(device).manual_seed(noise_seed)
        observations = self._split(envs.reset(seed=seeds)[0])
        self.takes_tensors = isinstance(observations[agents[0]], torch.Tensor)
        self.features, self.outcomes = self._join(observations), list[bool]()

    def make_model(self, agent: str, gripper_std: float | None, initial: DenseNetwork | None) -> ActorCritic:
        """Make an agent's networks; `gripper_std`: initial standard deviation of the last output, unless None."""
        observed, actions = self.envs.single_observation_space, self.envs.single_action_space
        if len(self.agents) > 1:
            observed, actions = observed(agent), actions(agent)
        stds = [self.args.initial_std] * actions.shape[0]
        stds[-1] = stds[-1] if gripper_std is None else gripper_std
        n_features = self.features[agent].shape[-1]
        return ActorCritic(flatdim(observed), stds, self.args.width, initial, n_features).to(self.device)

    def _split(self, values: Any) -> Any:
        """Return values by agent; environments of one agent give them without a dict."""
        return values if len(self.agents) > 1 else {self.agents[0]: values}

    def _join(self, observations: dict[str, Any]) -> dict[str, torch.Tensor]:
        """Return each agent's features, followed by those of the other agent if value functions observe both."""
        own = [torch.as_tensor(observations[agent]) for agent in self.agents]
        if self.sees_both:
            own = [torch.cat(parts, -1) for parts in (own, own[::-1])]
        return dict(zip(self.agents, own, strict=True))

    @torch.no_grad()
    def collect(self, models: dict[str, ActorCritic]) -> dict[str, Batch]:
        """Take steps for one update; return each agent's decisions; `outcomes` gets the success of ended episodes."""
        self.outcomes = []
        steps = [self._step(models) for _ in range(self.args.batch_size // self.args.num_envs)]
        batches = {}
        for agent, model in models.items():
            parts = map(torch.stack, zip(*(step[agent] for step in steps), strict=True))
            features, actions, log_probs, values, rewards, continues = parts
            last_values = model.compute_value(self.features[agent])
            advantages = compute_advantages(rewards, values, continues, last_values, self.args)
            batches[agent] = Batch(features, actions, log_probs, advantages, advantages + values)
        return batches

    def _step(self, models: dict[str, ActorCritic]) -> dict[str, tuple[torch.Tensor, ...]]:
        features = self.features
        policies = {agent: model.compute_distribution(features[agent]) for agent, model in models.items()}
        actions = {}
        for agent, policy in policies.items():
            noise = torch.randn(policy.mean.shape, generator=self.generator, device=self.device)
            actions[agent] = policy.mean + policy.stddev * noise
        given: dict[str, Any] = {agent: own if self.takes_tensors else own.numpy() for agent, own in actions.items()}
        result = self.envs.step(given if len(self.agents) > 1 else given[self.agents[0]])
        found, rewards, terminated, truncated, infos = map(self._split, result)
        # Episodes end for both agents at once.
        terminal = torch.as_tensor(terminated[self.agents[0]])
        ended = terminal | torch.as_tensor(truncated[self.agents[0]])
        for number in ended.nonzero()[:, 0].tolist():
            status = int(infos[self.agents[0]]["final_info"]["status"][number])
            self.outcomes.append(status == handover_marl.EpisodeStatus.SUCCESS)
            if not terminal[number]:
                # The value of the last state replaces the missing rewards after the truncation.
                last = self._join({agent: infos[agent]["final_obs"][number] for agent in self.agents})
                for agent, model in models.items():
                    rewards[agent][number] += self.args.discount * model.compute_value(last[agent]).item()
        self.features = self._join(found)
        return {
            agent: (
                features[agent],
                actions[agent],
                policies[agent].log_prob(actions[agent]).sum(-1),
                model.compute_value(features[agent]),
                torch.as_tensor(rewards[agent]).float(),
                (~ended).float(),
            )
            for agent, model in models.items()
        }


def compute_advantages(
    rewards: torch.Tensor, values: torch.Tensor, continues: torch.Tensor, last_values: torch.Tensor, args: RlArgs
) -> torch.Tensor:
    """Return generalized advantage estimates (k, n) of k steps of n environments (Schulman et al., ICLR 2016).

    `continues` (k, n) is 0 in steps that end an episode, else 1; `last_values` (n,) are the values after the last step.
    """
    advantages, advantage, next_values = torch.zeros_like(rewards), torch.zeros_like(last_values), last_values
    for step in reversed(range(len(rewards))):
        error = rewards[step] + args.discount * next_values * continues[step] - values[step]
        advantage = error + args.discount * args.gae_lambda * continues[step] * advantage
        advantages[step], next_values = advantage, values[step]
    return advantages


def update(model: ActorCritic, optimizer: torch.optim.Optimizer, batch: Batch, args: RlArgs) -> None:
    """Update both networks by PPO (Schulman et al., 2017) on a batch of decisions, in `args.epochs` passes."""
    count = batch.advantages.numel()
    rows = Batch(*(part.reshape(count, *part.shape[2:]) for part in batch))
    for _ in range(args.epochs):
        for numbers in torch.randperm(count).to(batch.features.device).split(args.minibatch_size):
            part = Batch(*(values[numbers] for values in rows))
            policy = model.compute_distribution(part.features)
            ratio = (policy.log_prob(part.actions).sum(-1) - part.log_probs).exp()
            clipped = ratio.clamp(1.0 - args.clip_range, 1.0 + args.clip_range)
            gain = (part.advantages - part.advantages.mean()) / (part.advantages.std() + 1e-8)
            value_loss = (model.compute_value(part.features) - part.targets).square().mean()
            optimizer.zero_grad()
            (0.5 * value_loss - torch.min(ratio * gain, clipped * gain).mean()).backward()
            nn.utils.clip_grad_norm_(model.parameters(), 0.5)
            optimizer.step()


def train(
    args: RlArgs,
    agents: tuple[str, ...],
    workers: int,
    sees_both: bool = False,
    gripper_std: float | None = None,
    initial: DenseNetwork | None = None,
    device: str = CPU,
    minutes: float = math.inf,
    **options: Any,
) -> dict[str, ActorCritic]:
    """Train agents until the limit of decisions or of time is reached, and return the networks of each agent.

    Args:
        args: Arguments of the training.
        agents: Agents that learn.
        workers: Number of processes that simulate the environments; the result depends on it.
        sees_both: Whether the value function of an agent observes the features of both agents.
        gripper_std: Initial standard deviation of the last output; default: as for the other outputs.
        initial: Network with which the policy starts; None: a new one.
        device: Device of environments and networks.
        minutes: Largest wall-clock time (min).
        options: Arguments of `handover_marl.vector_env`.
    """
    if args.num_envs % workers or args.batch_size % args.num_envs:
        raise OptionError(
            f"num_envs must be a multiple of workers, and batch_size of num_envs, got {args.num_envs} environments, "
            f"{workers} workers and {args.batch_size} decisions an update"
        )
    started, decisions = time.monotonic(), 0
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)  # The networks are small, and the other cores simulate.
    options |= {"autoreset": "same_step", **args.env_options}

    def make_collector(number: int) -> Collector:
        agent = agents[0] if len(agents) == 1 else None
        envs = handover_marl.vector_env(args.num_envs // workers, agent, **options)
        return Collector(number, args, agents, envs, sees_both, device)

    with ThreadPoolExecutor(workers) as pool:
        collectors = list(pool.map(make_collector, range(workers)))
        models = {agent: collectors[0].make_model(agent, gripper_std, initial) for agent in agents}
        optimizers = {agent: torch.optim.Adam(own.parameters(), args.learning_rate) for agent, own in models.items()}
        first_step = time.monotonic()
        while decisions < args.decisions and time.monotonic() - started < 60.0 * minutes:
            found = list(pool.map(lambda collector: collector.collect(models), collectors))
            decisions += args.batch_size
            for agent, model in models.items():
                parts = zip(*(batches[agent] for batches in found), strict=True)
                batch = Batch(*(torch.cat(part, dim=1) for part in parts))
                update(model, optimizers[agent], batch, args)
            outcomes = [outcome for collector in collectors for outcome in collector.outcomes]
            now = time.monotonic()
            print(
                f"{decisions} decisions, {now - started:.1f} s, {decisions / (now - first_step):.0f} decisions/s: "
                f"success of {len(outcomes)} training episodes {sum(outcomes) / max(1, len(outcomes)):.1%}",
                flush=True,
            )
    for collector in collectors:
        collector.envs.close()
    return {agent: model.cpu() for agent, model in models.items()}


def main(args: Args) -> Path:
    # `module:name` may be in the working folder, which Python does not search when it runs a script.
    sys.path.append(str(Path.cwd()))
    agent, args = args.agent, args.resolve_setup()
    args = replace(
        args,
        partner=args.partner or _PARTNERS[agent],
        features=args.features or FEATURES[agent],
        action_scheme=args.action_scheme or SCHEMES[agent],
    )
    check_backend(BatchBackend(args.backend, args.device))
    if args.backend == WARP:
        args = replace(args, workers=1)
    check_policy_path(args.out)
    args.out.parent.mkdir(parents=True, exist_ok=True)  # early, so that an error costs no training
    initial = None
    if args.initial is not None:
        spec, initial, _ = read_policy(args.initial, agent)
        if (initial.activation, initial.output) != ("tanh", "identity") or (
            initial.bounds and initial.bounds.is_scaled
        ):
            raise OptionError(
                f"initial must be a network with tanh layers and outputs that are not squashed, got {args.initial} "
                f"with {initial.activation} layers and the output {initial.output}"
            )
        args = replace(args, features=spec.features, action_scheme=spec.actions, control_period=spec.control_period)
    where = {"processes": 1} if args.backend == THREADS else {"backend": args.backend, "device": args.device}
    models = train(
        args,
        (agent,),
        args.workers,
        # Closing at random succeeds sometimes, so the gripper's output is explored more than the motion.
        gripper_std=args.gripper_initial_std if agent == "receiver" else None,
        initial=initial and initial.copy_to(make_tensor_factory(args.device)),
        device=args.device,
        minutes=args.minutes,
        partner=args.partner,
        features=args.features,
        action_scheme=args.action_scheme,
        rewards=set_discount(args.rewards, args.discount),
        **where,
    )
    origin = describe_origin("train_ppo", args)
    spec = PolicySpec(agent, args.features, args.action_scheme, args.control_period, origin)
    network = dense_network_from_layers(models[agent].actor, "tanh")
    if initial is not None:
        network = replace(network, normalization=initial.normalization)
    write_policy(args.out, spec, network)
    print(args.out)
    if args.val_scenes:
        giver, receiver = (args.partner if agent != name else f"learned:{args.out}" for name in AGENTS)
        label = f"{args.setup} val with the partner {args.partner}"
        # The caller has named own features and schemes, so they may be imported.
        trust = is_reference(args.features) or is_reference(args.action_scheme)
        validate(args, args.val_scenes, giver, receiver, label, physics=args.val_physics, trust=trust)
    return args.out


if __name__ == "__main__":
    run_script(main, Args, __doc__)
