"""Train the weights of the giver `adaptive`, which chooses its offer: a contextual bandit with one choice per episode.

    python experiments/training/train_giver_offers.py --data-dir DIR --out runs/offers

An offer is the handover pose and the withdrawal of `HandoverPoseScheme`; the rest of the person's motion is scripted. A
network predicts success and time of an offer from `OfferFeatures`. Offers of the first round are random. In later
rounds, the network chooses among 1, 4, 16 or 64 random ones and, unless there is only 1, the recorded pose. It is
trained anew after each round. The folder gets `offers.npz`, the offers of all rounds, and `policy.npz`
(`--givers adaptive:weights=runs/offers/policy.npz`); `--resume` continues a run.
"""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from torch import nn

import handover_marl
from handover_marl.config import ProtocolConfig
from handover_marl.episode.observations import add_episode_axis, giver_observation_space
from handover_marl.errors import OptionError
from handover_marl.execution.files import write_arrays
from handover_marl.learning.adaptive_giver import (
    N_OFFER_FEATURES,
    OFFER_FEATURES,
    OfferFeatures,
    compute_offer_scores,
    draw_offers,
)
from handover_marl.learning.imitation.run import join_samples, read_samples
from handover_marl.learning.policy_files import DenseNetwork, PolicySpec, write_policy
from handover_marl.learning.training.run_folder import (
    describe_origin,
    fit_network,
    open_run_folder,
    spawn_seeds,
    validate,
)
from handover_marl.learning.training.scene_arguments import SetupArgs, run_script
from handover_marl.policies.policy import make_policy_context
from handover_marl.policies.reference import parse_policy

ACTIONS, CONTROL_PERIOD = "offer", 0.1
OFFERS, POLICY = "offers.npz", "policy.npz"


@dataclass(frozen=True)
class Args(SetupArgs):
    """Arguments of the training of a giver that chooses its offer.

    Attributes:
        out: Folder of the run.
        seed: Seed of all random numbers.
        receivers: Receivers of the training; the environments are divided among them.
        episodes: Number of episodes.
        round_episodes: Number of episodes between trainings of the network.
        num_envs: Number of environments.
        workers: Number of processes that simulate the environments; the result depends on it. It must be a multiple of
            the number of receivers.
        spread: Standard deviation of the random offers.
        candidates: Numbers of random offers of which the best is taken; each decision draws one of these numbers.
        ignored: Numbers of the features (0 to 47) that the network does not use, for ablations.
        width: Width of the two hidden layers of the network.
        dropout: Share of the hidden units that a gradient step leaves out.
        updates: Number of gradient steps in each training of the network.
        batch_size: Number of episodes per gradient step.
        learning_rate: Learning rate of AdamW at the start; it decays to zero.
        weight_decay: Weight decay of AdamW.
        val_scenes: Number of validation scenes in the final evaluation, evenly chosen; 0 skips it.
        val_physics: Physics of the final evaluation: fast, exact or mujoco.
        resume: Whether to continue the run in the folder `out`.
    """

    out: Path = Path("runs/offers")
    seed: int = 0
    receivers: tuple[str, ...] = ("yang2021:close_decision_period=0.1",)
    episodes: int = 50_000
    round_episodes: int = 2_048
    num_envs: int = 256
    workers: int = 2
    spread: float = 0.5
    candidates: tuple[int, ...] = (1, 4, 16, 64)
    ignored: tuple[int, ...] = ()
    width: int = 128
    dropout: float = 0.2
    updates: int = 1_500
    batch_size: int = 512
    learning_rate: float = 1e-3
    weight_decay: float = 0.1
    val_scenes: int = 36
    val_physics: str = "mujoco"
    resume: bool = False


class Offers(NamedTuple):
    """Offers of a giver in n episodes, and the outcomes of these episodes.

    Attributes:
        features: Features (n, 48) of the offers.
        status: `EpisodeStatus` (n,) at the end, as integers.
        steps: Numbers (n,) of physics steps of the episodes.
        receivers: Indices (n,) of the receivers.
        scenes: Scene numbers (n,).
    """

    features: np.ndarray
    status: np.ndarray
    steps: np.ndarray
    receivers: np.ndarray
    scenes: np.ndarray

    @property
    def successes(self) -> np.ndarray:
        """Whether each episode is a success, (n,)."""
        successes: np.ndarray = self.status == int(handover_marl.EpisodeStatus.SUCCESS)
        return successes


class Collector:
    """Collector of offers from environments with one receiver, simulated in a process of their own.

    Args:
        number: Number of the collector; it selects the receiver and is part of the seed.
        args: Arguments of the training.
        n_earlier_episodes: Number of episodes of earlier runs, part of the seed.
    """

    def __init__(self, number: int, args: Args, n_earlier_episodes: int) -> None:
        self.args, self.receiver = args, number % len(args.receivers)
        count, dataset = args.num_envs // args.workers, args.open_dataset()
        seed, *seeds = spawn_seeds(1 + count, args.seed, number, n_earlier_episodes)
        self.rng = np.random.default_rng(seed)
        self.features = OfferFeatures(make_policy_context(dataset, setup=args.setup))
        self.envs = handover_marl.vector_env(
            count,
            "giver",
            args.receivers[self.receiver],
            features="flat_giver",
            action_scheme=ACTIONS,
            autoreset="same_step",
            control_period=CONTROL_PERIOD,
            processes=1,
            **args.scene_options,
        )
        self.observations = self.envs.reset(seed=seeds)[0]

    def collect(self, network: DenseNetwork | None) -> list[Offers]:
        """Return the offers of one round: random ones without a network, else each the best of several random ones."""
        return [self._step(network) for _ in range(max(1, self.args.round_episodes // self.args.num_envs))]

    def _step(self, network: DenseNetwork | None) -> Offers:
        choices = [self._choose(network, vector) for vector in self.observations]
        features, offers = (np.stack(part) for part in zip(*choices, strict=True))
        self.observations, _, terminated, truncated, infos = self.envs.step(offers)
        # Objects without known grasps have no features.
        ended, final = (terminated | truncated) & np.isfinite(features[:, 0]), infos["final_info"]
        return Offers(
            features[ended],
            final["status"][ended],
            final["steps"][ended],
            np.full(int(ended.sum()), self.receiver),
            final["scene_id"][ended],
        )

    def _choose(self, network: DenseNetwork | None, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return features (48,), nan without known grasps, and the offer (7,) that is chosen for a flat observation."""
        count = 1 if network is None else int(self.rng.choice(self.args.candidates))
        # The first offer is the recorded pose: a candidate beside several random ones, but never the only one.
        offers = draw_offers(self.rng, count + 1, self.args.spread)[0 if count > 1 else 1 :]
        space: spaces.Space[Any] = giver_observation_space()
        observation = add_episode_axis(spaces.unflatten(space, vector))
        features = self.features(observation, offers)
        if features is None:
            return np.full(N_OFFER_FEATURES, np.nan, np.float32), offers[0]
        best = 0 if network is None else int(np.argmax(compute_offer_scores(network(features))))
        return features[best], offers[best]


def fit(offers: Offers, args: Args, seed: int) -> DenseNetwork:
    """Train a new network that maps features (48,) of an offer to success (logit) and time (share of the limit)."""
    torch.manual_seed(seed)
    is_used = torch.ones(offers.features.shape[1]).index_fill(0, torch.tensor(args.ignored, dtype=torch.int64), 0.0)
    inputs, successes = torch.as_tensor(offers.features) * is_used, torch.as_tensor(offers.successes).float()
    durations = torch.as_tensor(offers.steps / ProtocolConfig().horizon_steps).float()
    hidden = [(nn.Linear(n, args.width), nn.SiLU(), nn.Dropout(args.dropout)) for n in (inputs.shape[1], args.width)]
    network = nn.Sequential(*hidden[0], *hidden[1], nn.Linear(args.width, 2))
    hidden[0][0].weight.data *= is_used  # These weights stay 0, because their inputs are 0.

    def compute_loss(outputs: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        logits, times = outputs.unbind(-1)
        loss = nn.functional.binary_cross_entropy_with_logits(logits, successes[rows])
        # Only successes train the time: the time of a failure says nothing about that of a success.
        errors = (times - durations[rows]).square() * successes[rows]
        return loss + errors.sum() / successes[rows].sum().clamp(min=1)

    batches = torch.randint(len(inputs), (args.updates, args.batch_size)).unbind()
    return fit_network(network, "silu", inputs, batches, compute_loss, args.learning_rate, args.weight_decay)


def train(args: Args, folder: Path) -> Offers:
    """Collect offers and store them in `folder` until the number of episodes is reached; return all offers."""
    torch.set_num_threads(1)
    path = folder / OFFERS
    offers = read_samples(Offers, path) if path.exists() else None
    n_earlier_episodes = n_episodes = 0 if offers is None else len(offers.status)
    with ThreadPoolExecutor(args.workers) as pool:
        collectors = list(pool.map(lambda number: Collector(number, args, n_earlier_episodes), range(args.workers)))
        started = time.monotonic()
        while offers is None or n_episodes < args.episodes:
            network = None if offers is None else fit(offers, args, args.seed + n_episodes)
            parts = pool.map(Collector.collect, collectors, [network] * args.workers)
            found = join_samples([part for each in parts for part in each])
            offers = found if offers is None else join_samples([offers, found])
            n_episodes = len(offers.status)
            write_arrays(path, offers._asdict())
            print(
                f"{n_episodes} episodes, {(n_episodes - n_earlier_episodes) / (time.monotonic() - started):.1f} "
                f"episodes/s: success of the last {len(found.status)} {found.successes.mean():.1%}",
                flush=True,
            )
    for collector in collectors:
        collector.envs.close()
    return offers


def main(args: Args) -> Path:
    args = args.resolve_setup()
    for receiver in args.receivers:
        parse_policy("receiver", receiver)  # before the run's folder is made
    if args.workers % len(args.receivers) or args.num_envs % args.workers:
        raise OptionError(
            f"num_envs must be a multiple of workers, and workers of the number of receivers, got {args.num_envs}, "
            f"{args.workers} and {len(args.receivers)}"
        )
    folder = open_run_folder(args.out, args, args.resume, args.open_dataset().name, ("episodes", "ignored", "workers"))
    network = fit(train(args, folder), args, args.seed)
    spec = PolicySpec("giver", OFFER_FEATURES, ACTIONS, CONTROL_PERIOD, describe_origin("train_giver_offers", args))
    write_policy(folder / POLICY, spec, network)
    for receiver in args.receivers if args.val_scenes else ():
        for giver in ("replay", f"adaptive:weights={folder / POLICY}"):
            label = f"{receiver} with {giver}"
            validate(args, args.val_scenes, giver, receiver, label, physics=args.val_physics)
    return folder / POLICY


if __name__ == "__main__":
    print(run_script(main, Args, __doc__))
