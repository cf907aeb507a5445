"""Train a giver that chooses its offer: a contextual bandit with one decision in each episode.

    python experiments/training/train_giver_offers.py --data-dir DIR --out runs/offers

The decision is the handover pose and the withdrawal of `HandoverPoseScheme`; the rest of the person's motion is
scripted. An ensemble of critics predicts the success and the time of an offer from what the giver observes when it
decides. The first round has random offers; in later rounds each environment takes the best of many random offers by one
critic, drawn at random (Thompson sampling). At the end an actor maximizes the score of all critics. The folder gets
`policy.npz` (`--givers learned:runs/offers/policy.npz`) and `offers.npz`, the decisions of all rounds; `--resume`
continues a run.
"""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

import handover_marl
from handover_marl.config import ProtocolConfig
from handover_marl.execution.files import write_arrays
from handover_marl.execution.reading import read_arrays
from handover_marl.learning.adapters.modules import dense_network_from_module
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import PolicySpec
from handover_marl.learning.training.run_folder import (
    describe_origin,
    make_mlp,
    open_run_folder,
    select_training_scenes,
    spawn_seeds,
    summarize_evaluation,
)
from handover_marl.learning.training.scene_arguments import SetupArgs, run_script
from handover_marl.policies.reference import parse_policy

FEATURES, ACTIONS, CONTROL_PERIOD = "giver", "offer", 0.1
OFFERS, POLICY = "offers.npz", "policy.npz"


@dataclass(frozen=True)
class Args(SetupArgs):
    """Arguments of the training of a giver that chooses its offer.

    Attributes:
        out: Folder of the run.
        seed: Seed of all random numbers.
        receivers: Receivers that the giver learns for; environments are divided among them.
        episodes: Number of episodes.
        round_episodes: Number of episodes between updates of the critics.
        num_envs: Number of environments.
        workers: Number of processes that simulate the environments, a multiple of the number of receivers.
        spread: Standard deviation of the random offers.
        candidates: Number of random offers that are compared in each decision.
        critics: Number of critics.
        width: Width of the two hidden layers of each network.
        updates: Number of gradient steps after each round.
        batch_size: Number of episodes per gradient step.
        learning_rate: Learning rate of Adam.
        caution: Number of standard deviations between critics by which the actor's score is lowered.
        val_scenes: Largest number of validation scenes in the final evaluation; 0 skips it.
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
    candidates: int = 256
    critics: int = 5
    width: int = 128
    updates: int = 1_000
    batch_size: int = 512
    learning_rate: float = 1e-3
    caution: float = 1.0
    val_scenes: int = 36
    val_physics: str = "mujoco"
    resume: bool = False


class Offers(NamedTuple):
    """Decisions of a giver in n episodes, and the outcomes of these episodes.

    Attributes:
        features: Features (n, 39) at the decision.
        outputs: Outputs (n, 7) of the action scheme.
        status: Bits (n,) of the `EpisodeStatus` at the end.
        steps: Numbers (n,) of physics steps of the episodes.
        receivers: Indices (n,) of the receivers.
        scenes: Scene numbers (n,).
    """

    features: np.ndarray
    outputs: np.ndarray
    status: np.ndarray
    steps: np.ndarray
    receivers: np.ndarray
    scenes: np.ndarray

    @property
    def successes(self) -> np.ndarray:
        """Whether each episode is a success, (n,)."""
        successes: np.ndarray = self.status == int(handover_marl.EpisodeStatus.SUCCESS)
        return successes


class Critics(nn.Module):
    """Ensemble of networks that predict success and time of offers from the features and outputs of a decision."""

    def __init__(self, n_features: int, n_outputs: int, args: Args) -> None:
        super().__init__()
        self.members = nn.ModuleList(make_mlp(n_features + n_outputs, 2, args.width) for _ in range(args.critics))

    def compute_scores(self, member: nn.Module, features: torch.Tensor, outputs: torch.Tensor) -> torch.Tensor:
        """Return the expected average success (...) of offers by one network: success probability times saved time."""
        logits, duration = member(torch.cat([features, outputs], dim=-1)).unbind(-1)
        scores: torch.Tensor = logits.sigmoid() * (1.0 - duration.clamp(0.0, 1.0))
        return scores

    def compute_cautious_scores(self, features: torch.Tensor, outputs: torch.Tensor, caution: float) -> torch.Tensor:
        """Return the mean (...) of all networks' scores of offers, minus their standard deviation times `caution`."""
        scores = torch.stack([self.compute_scores(member, features, outputs) for member in self.members])
        return scores.mean(0) - caution * scores.std(0)


class Collector:
    """Collector of offers from environments with one receiver, which are simulated in a process of their own."""

    def __init__(self, number: int, args: Args, rounds: int) -> None:
        self.args, self.receiver = args, number % len(args.receivers)
        count = args.num_envs // args.workers
        noise_seed, *seeds = spawn_seeds(1 + count, args.seed, number, rounds)
        self.generator = torch.Generator().manual_seed(noise_seed)
        self.envs = handover_marl.vector_env(
            count,
            "giver",
            args.receivers[self.receiver],
            features=FEATURES,
            schemes=ACTIONS,
            autoreset="same_step",
            setup=args.setup,
            split="train",
            scenes=select_training_scenes(args.open_dataset().list_scenes(args.setup, "train")),
            dataset=args.dataset,
            data_dir=args.data_dir,
            control_period=CONTROL_PERIOD,
            processes=1,
        )
        self.features = self.envs.reset(seed=seeds)[0]

    @torch.no_grad()
    def collect(self, critics: Critics | None) -> list[Offers]:
        """Return the offers of one round, random ones without critics, else each the best of many by one critic."""
        steps = max(1, self.args.round_episodes // self.args.num_envs)
        return [self._step(critics) for _ in range(steps)]

    def _step(self, critics: Critics | None) -> Offers:
        features = torch.as_tensor(self.features)
        count, size = len(features), self.envs.single_action_space.shape[0]
        noise = torch.randn((count, self.args.candidates, size), generator=self.generator)
        candidates = (self.args.spread * noise).clamp(-1.0, 1.0)
        outputs = candidates[:, 0].clone()
        if critics is not None:
            chosen = torch.randint(len(critics.members), (count,), generator=self.generator)
            for number, member in enumerate(critics.members):
                rows = (chosen == number).nonzero()[:, 0]
                repeated = features[rows, None].expand(-1, self.args.candidates, -1)
                best = critics.compute_scores(member, repeated, candidates[rows]).argmax(1)
                outputs[rows] = candidates[rows, best]
        self.features, _, terminated, truncated, infos = self.envs.step(outputs.numpy())
        ended, final = terminated | truncated, infos["final_info"]
        return Offers(
            features.numpy()[ended],
            outputs.numpy()[ended],
            final["status"][ended],
            final["steps"][ended],
            np.full(int(ended.sum()), self.receiver),
            final["scene_id"][ended],
        )


def update(critics: Critics, optimizer: torch.optim.Optimizer, offers: Offers, args: Args, seed: int) -> float:
    """Update the critics by gradient steps on random batches of all episodes; return their mean last loss."""
    inputs = torch.as_tensor(np.concatenate([offers.features, offers.outputs], axis=1))
    successes = torch.as_tensor(offers.successes)
    durations = torch.as_tensor(offers.steps / ProtocolConfig().horizon_steps).float()
    generator, loss = torch.Generator().manual_seed(seed), torch.zeros(())
    for _ in range(args.updates):
        optimizer.zero_grad()
        loss = torch.zeros(())
        for member in critics.members:
            rows = torch.randint(len(inputs), (args.batch_size,), generator=generator)
            logits, duration = member(inputs[rows]).unbind(-1)
            loss = loss + nn.functional.binary_cross_entropy_with_logits(logits, successes[rows].float())
            # The time of a failure says nothing about that of a success.
            errors = (duration - durations[rows]).square() * successes[rows]
            loss = loss + errors.sum() / successes[rows].sum().clamp(min=1)
        loss.backward()
        optimizer.step()
    return float(loss.detach()) / len(critics.members)


def train_actor(critics: Critics, offers: Offers, args: Args) -> nn.Module:
    """Train and return a network that maximizes the critics' cautious score of its outputs at the observed features."""
    features = torch.as_tensor(offers.features)
    actor = make_mlp(features.shape[1], offers.outputs.shape[1], args.width, 0.01)
    optimizer = torch.optim.Adam(actor.parameters(), args.learning_rate)
    generator = torch.Generator().manual_seed(args.seed)
    for _ in range(2 * args.updates):
        rows = torch.randint(len(features), (args.batch_size,), generator=generator)
        outputs = actor(features[rows])
        # Outputs beyond the bounds have no effect.
        beyond = (outputs.abs() - 1.0).clamp(min=0.0).square().mean()
        score = critics.compute_cautious_scores(features[rows], outputs.clamp(-1.0, 1.0), args.caution).mean()
        optimizer.zero_grad()
        (beyond - score).backward()
        optimizer.step()
    return actor


def train(args: Args, folder: Path) -> tuple[Critics, Offers]:
    """Collect offers and train critics until the number of episodes is reached; return the critics and all offers.

    The offers are also in `folder`, from which a resumed run continues.
    """
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    path, offers = folder / OFFERS, None
    if path.exists():
        offers = Offers(**read_arrays(path, Offers._fields))
    first = known = 0 if offers is None else len(offers.status)
    with ThreadPoolExecutor(args.workers) as pool:
        collectors = list(pool.map(lambda number: Collector(number, args, first), range(args.workers)))
        critics = Critics(collectors[0].features.shape[1], collectors[0].envs.single_action_space.shape[0], args)
        optimizer = torch.optim.Adam(critics.parameters(), args.learning_rate, weight_decay=1e-5)
        if offers is not None:
            update(critics, optimizer, offers, args, args.seed)
        started = time.monotonic()
        while offers is None or known < args.episodes:
            current = None if offers is None else critics
            parts = pool.map(Collector.collect, collectors, [current] * args.workers)
            found = join([part for each in parts for part in each])
            offers = found if offers is None else join([offers, found])
            known = len(offers.status)
            write_arrays(path, offers._asdict())
            loss = update(critics, optimizer, offers, args, args.seed + known)
            print(
                f"{known} episodes, {(known - first) / (time.monotonic() - started):.1f} episodes/s: success of the "
                f"last {len(found.status)} {found.successes.mean():.1%}, loss {loss:.3f}",
                flush=True,
            )
    for collector in collectors:
        collector.envs.close()
    return critics, offers


def join(parts: list[Offers]) -> Offers:
    """Concatenate the offers of several parts."""
    return Offers(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def main(args: Args) -> Path:
    args = args.resolve_setup()
    for receiver in args.receivers:
        parse_policy("receiver", receiver)  # before the run's folder is made
    folder = open_run_folder(args.out, args, args.resume, args.open_dataset().name, ("episodes", "workers"))
    critics, offers = train(args, folder)
    actor = train_actor(critics, offers, args)
    spec = PolicySpec("giver", FEATURES, ACTIONS, CONTROL_PERIOD, describe_origin("train_giver_offers", args))
    write_policy(folder / POLICY, spec, dense_network_from_module(actor, "tanh"))
    scenes = args.open_dataset().list_scenes(args.setup, "val")[: args.val_scenes]
    for receiver in args.receivers if scenes else ():
        for giver in ("replay", f"learned:{folder / POLICY}"):
            report = handover_marl.evaluate_pair(
                giver,
                receiver,
                args.setup,
                "val",
                scenes=scenes,
                dataset=args.dataset,
                data_dir=args.data_dir,
                physics=args.val_physics,
            )
            print(summarize_evaluation(report, f"{receiver} with {giver}"))
    return folder / POLICY


if __name__ == "__main__":
    print(run_script(main, Args, __doc__))
