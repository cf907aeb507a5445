"""Giver that chooses where and how to offer the object, by a network that predicts the success of offers."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import handover_marl.givers
from handover_marl.config import CheckedConfig, bounded
from handover_marl.episode.observations import Observation
from handover_marl.errors import DataFormatError
from handover_marl.geometry.arrays import AnyIndices, ArrayFactory, to_numpy
from handover_marl.givers.array_giver import ArrayGiver
from handover_marl.learning.giver_schemes import HandoverPoseScheme
from handover_marl.learning.grasp_selector import LowestCostGraspSelector
from handover_marl.learning.offers import (
    N_OFFER_FEATURES,
    OFFER_FEATURES,
    OfferFeatures,
    Vectors,
    compute_added_reaches,
    compute_offer_scores,
    draw_offers,
)
from handover_marl.learning.policy_files import read_policy
from handover_marl.policies.batch import Actions
from handover_marl.policies.policy import PolicyContext

_SHIPPED = Path(handover_marl.givers.__file__).parent / "policies" / "adaptive.npz"


@dataclass(frozen=True)
class AdaptiveConfig(CheckedConfig):
    """Configuration of `AdaptiveGiver`.

    Attributes:
        patience: Time without an approach after which the giver varies its handover pose (s).
        offers: Number of random offers of which the best is chosen; the first has the recorded handover pose.
        spread: Standard deviation of the random offers, relative to the bounds of `HandoverPoseScheme`.
        reach_cost: Reduction of an offer's score (0 to 1) for each metre that the person reaches farther than in the
            recording (1/m).
    """

    patience: float = bounded(6.0, 0.0, 60.0)
    offers: int = bounded(256, 1, 10_000)
    spread: float = bounded(0.5, 0.0, 10.0)
    reach_cost: float = bounded(0.5, 0.0, 100.0)


class AdaptiveGiver(ArrayGiver):
    """Giver that chooses the best of many random offers when the recorded hand is about to stop.

    An offer is a handover pose and a withdrawal; the rest of the motion is that of `HandoverPoseScheme`. A network
    predicts success and time of an offer from what the person sees, see `handover_marl.learning.offers`. It was trained
    with the receiver `yang2021`, but does not observe who the receiver is. Objects without known grasps are handed over
    at the recorded pose.

    Args:
        context: Robot, task and known grasps of the objects.
        weights: Policy file of `experiments/training/train_giver_offers.py`; default: the one that ships.
        options: Numbers in `AdaptiveConfig`.
    """

    name = "adaptive"
    file_options = ("weights",)
    config: AdaptiveConfig = AdaptiveConfig()

    def __init__(self, context: PolicyContext, weights: str | None = None, **options: float) -> None:
        path = _SHIPPED if weights is None else Path(weights).expanduser()
        spec, self._network, self._weights = read_policy(path, "giver")
        sizes = self._network.n_inputs, self._network.n_outputs
        if spec.features != OFFER_FEATURES or sizes != (N_OFFER_FEATURES, 2):
            raise DataFormatError(
                f"{path}: weights of giver 'adaptive' must be a file of train_giver_offers.py, got a policy with "
                f"features {spec.features!r}"
            )
        super().__init__(context, **options)
        self._features = OfferFeatures(context)

    @property
    def weights_hash(self) -> str:
        """Name and hash of the policy file."""
        return self._weights

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the state of `count` episodes, in arrays that `arrays` creates."""
        super().allocate(count, arrays)
        selector = LowestCostGraspSelector(self.context, count, arrays)
        self._scheme = HandoverPoseScheme(self.context, selector, count, arrays)
        self._scheme.pose_variation.timeout = self.config.patience

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row`; `seed` determines the random offers."""
        super().start(row, seed)
        self._scheme.reset(row)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: replay until an offer is chosen, then move to it."""
        needed = to_numpy(self._scheme.needs_outputs(rows, observation)).nonzero()[0]
        for place in needed.tolist():
            own = {key: to_numpy(values[place : place + 1]) for key, values in observation.items()}
            offer = self._choose(self.rngs[int(rows[place])], own)
            self._scheme.set_outputs(rows[place : place + 1], self.arrays.asarray(offer[None]))
        return self._scheme.compute_actions(rows, observation)

    def _choose(self, rng: np.random.Generator, observation: Observation) -> Vectors:
        """Return the best (7,) of many random offers for an observation (1, ...), or the first if no grasp is known."""
        offers = draw_offers(rng, self.config.offers, self.config.spread)
        features, number = self._features(observation, offers), 0
        if features is not None:
            costs = self.config.reach_cost * compute_added_reaches(observation, offers)
            number = int(np.argmax(compute_offer_scores(self._network(features)) - costs))
        best: Vectors = offers[number]
        return best
