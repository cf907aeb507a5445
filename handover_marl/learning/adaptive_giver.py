"""Giver that chooses where and how to hold out the object, by a network that predicts the success of such offers.

An offer is a vector of seven numbers, the outputs that `HandoverPoseScheme` decodes: handover pose and withdrawal. The
network's inputs depend on what a person can see (the object, the own hand, the robot) and on the known grasps of the
object, but not on the receiver's policy.
"""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

import handover_marl.givers
from handover_marl.config import CheckedConfig, bounded
from handover_marl.episode.metrics.fluency import CHEST, HALF_SHOULDER_WIDTH
from handover_marl.episode.observations import Observation
from handover_marl.errors import DataFormatError
from handover_marl.geometry.arrays import AnyArray, AnyIndices, ArrayFactory, get_namespace, to_float64, to_numpy
from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose
from handover_marl.geometry.rotations import multiply_quaternions, quaternions_from_rotation_vectors
from handover_marl.givers.array_giver import ArrayGiver
from handover_marl.grasps.known_grasps import load_hand_poses
from handover_marl.grasps.selector import (
    MAX_REACH_DISTANCE,
    GraspCosts,
    LowestCostGraspSelector,
    load_validated_grasps,
)
from handover_marl.learning.encodings.features import compute_handover_frames, rotate_to_world
from handover_marl.learning.encodings.schemes import HandoverPoseScheme
from handover_marl.learning.policy_files import read_policy
from handover_marl.policies.batch import Actions
from handover_marl.policies.policy import PolicyContext

Array = npt.NDArray[np.float64]
Vectors = npt.NDArray[np.float32]

#: Name of the features in policy files, and the number of features of an offer.
OFFER_FEATURES, N_OFFER_FEATURES = "offer_grasps", 48
# Numbers of nearest grasps over which clearances are averaged, and number of best grasps whose reach is computed.
_NUMBERS_OF_GRASPS, _N_BEST = (1, 4, 16, 64), 4


def draw_offers(rng: np.random.Generator, count: int, spread: float) -> Vectors:
    """Draw `count` offers (count, 7), float32, from a normal distribution, and clip them to [-1, 1].

    The first one has the recorded handover pose, with a random withdrawal. The standard deviation is `spread`.
    """
    offers = np.clip(spread * rng.standard_normal((count, HandoverPoseScheme.size)), -1.0, 1.0)
    offers[0, :6] = 0.0
    return offers.astype(np.float32)


def compute_offered_poses(observation: Observation, offers: Vectors) -> Array:
    """Return world poses (k, 7; xyzw) of the object at k offers (k, 7), given the giver's observation (1, ...)."""
    origins, frames = compute_handover_frames(observation)
    shifts = rotate_to_world(frames, to_float64(offers[:, :3]) * HandoverPoseScheme.max_output_translation)
    turns = rotate_to_world(frames, to_float64(offers[:, 3:6]) * HandoverPoseScheme.max_output_rotation)
    recorded = to_float64(observation["replay_object_poses"][:, -1, 3:])
    rotations = multiply_quaternions(quaternions_from_rotation_vectors(turns), recorded)
    return np.concatenate([origins + shifts, rotations], axis=1)


def compute_added_reaches(observation: Observation, offers: Vectors) -> Array:
    """Return how much farther the person reaches at k offers (k, 7) than in the recording, (k,) in m, at least 0.

    The reach is the distance of the wrist from the nearer shoulder of a person who faces the robot, at the handover
    pose. `observation` has the arrays (1, ...) of the giver's observation.
    """
    recorded = to_float64(observation["replay_wrist_poses"][:, -1])
    wrist_in_object = compose(invert_pose(to_float64(observation["replay_object_poses"][:, -1])), recorded)
    wrists = np.concatenate([recorded, compose(compute_offered_poses(observation, offers), wrist_in_object)])[:, :3]
    shoulders = np.array(CHEST) + HALF_SHOULDER_WIDTH * np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    reaches = np.linalg.norm(wrists[:, None] - shoulders, axis=2).min(axis=1)
    added: Array = (reaches[1:] - reaches[0]).clip(0.0)
    return added


class OfferFeatures:
    """Features (48) of each of a giver's offers, from which a network predicts the offer's success.

    | features | meaning |
    |---|---|
    | 0-18 | the known grasps of the object, see the second table |
    | 19-37 | likewise the validated grasps of the receiver `reactive`, which include tilted copies of the known ones |
    | 38-40 | position of the object at the recorded handover, in the world (m) |
    | 41-47 | the offer |

    The second table has the 19 features of a set of grasps. The nearest grasps are those with the lowest cost of the
    gripper's motion to them; the best ones have the lowest sum of the costs of motion, hold and clearance, see
    `GraspCosts`.

    | features | meaning |
    |---|---|
    | 0-3 | clearance between person's hand and gripper, mean over the 1, 4, 16, 64 nearest grasps (m, times 10) |
    | 4-7 | share of these grasps whose clearance is at least `GraspCosts.min_clearance` |
    | 8 | cost of the motion to the nearest grasp (m) |
    | 9-12 | best grasp: cost (m), clearance (m, times 10), cost of the motion (m), cost of the hold (s) |
    | 13-18 | distance from a reachable pose (m, times 10): nearest grasp, the four best grasps, least of these five |

    Args:
        context: Robot, and known grasps of the objects.
    """

    def __init__(self, context: PolicyContext) -> None:
        self._context, self._costs = context, GraspCosts(context)

    def __call__(self, observation: Observation, offers: Vectors) -> Vectors | None:
        """Return the features (k, 48) of k offers (k, 7) in one episode; None if no grasp of the object is known.

        `observation` has the arrays (1, ...) of the giver's observation.
        """
        object_class = int(observation["object_classes"][0, 0])
        sets = [load(self._context, object_class) for load in (_load_known_grasps, load_validated_grasps)]
        objects, found = compute_offered_poses(observation, offers), []
        for grasps in sets:
            if grasps is None:
                return None
            found.append(self._compute_set(observation, objects, *grasps))
        hands = compose(objects[:, None], np.concatenate([chosen for _, chosen in found], axis=1))
        robots = np.repeat(observation["robot_joint_position"], len(offers), axis=0)
        distances = 10.0 * self._costs.compute_reach_distances(hands, robots).clip(None, MAX_REACH_DISTANCE)
        parts = []
        for (numbers, _), reaches in zip(found, np.split(distances, len(sets), axis=1), strict=True):
            parts += [numbers, reaches, reaches.min(axis=1, keepdims=True)]
        origins, _ = compute_handover_frames(observation)
        parts += [np.broadcast_to(origins, (len(offers), 3)), to_float64(offers)]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def _compute_set(
        self, observation: Observation, objects: Array, grasps: Array, hold_costs: Array
    ) -> tuple[Array, Array]:
        """Return features 0-12 of a set of grasps at k offers (k, 13), and the nearest and four best grasps (k, 5, 7).

        `objects` (k, 7) are world poses of the object at the offers. The set, `grasps` (g, 7), has hold costs (g,) in
        s; all grasps are in the object's frame.
        """
        joints = inverse_transform_points(observation["object_poses"][:, :1], observation["hand_keypoints"])
        clearances = self._costs.compute_clearances(grasps[None], joints)[0]
        gripper = compose(invert_pose(objects), observation["gripper_pose"])
        motions = self._costs.compute_motion_costs(grasps[None], gripper)
        costs = motions + GraspCosts.hold_weight * hold_costs + self._costs.compute_clearance_costs(clearances)
        nearest, order = (np.argsort(values, axis=1, kind="stable") for values in (motions, costs))
        free, rows = clearances >= GraspCosts.min_clearance, np.arange(len(objects))
        first, best = nearest[:, 0], order[:, 0]
        numbers = [10.0 * clearances[nearest[:, :number]].mean(axis=1) for number in _NUMBERS_OF_GRASPS]
        numbers += [free[nearest[:, :number]].mean(axis=1) for number in _NUMBERS_OF_GRASPS]
        numbers += [motions[rows, first], costs[rows, best], 10.0 * clearances[best], motions[rows, best]]
        # Of fewer grasps, the last one is repeated.
        ranks = np.arange(_N_BEST).clip(max=len(grasps) - 1)
        chosen = grasps[np.concatenate([first[:, None], order[:, ranks]], axis=1)]
        return np.stack([*numbers, hold_costs[best]], axis=1), chosen


def compute_offer_scores(outputs: AnyArray) -> AnyArray:
    """Return scores (k,) of offers, higher is better: probability of success times the unused share of the time limit.

    The network's `outputs` (k, 2) are the logit of success, and the time of success as a share of the limit.
    """
    xp = get_namespace(outputs)
    return (1.0 - outputs[:, 1].clip(0.0, 1.0)) / (1.0 + xp.exp(-outputs[:, 0]))


@functools.lru_cache(maxsize=1024)
def _load_known_grasps(context: PolicyContext, object_class: int) -> tuple[Array, Array] | None:
    """Return the known grasps (g, 7) of an object class, with hold costs (g,) of zero; None if there are none.

    As in `load_validated_grasps`, the second half of the grasps is the first one turned by 180 degrees.
    """
    poses = load_hand_poses(context.load_grasps, context.object_names[object_class])
    if poses is None:
        return None
    poses = np.concatenate([poses, compose(poses, np.array(HALF_TURN))])
    return poses, np.zeros(len(poses))


_SHIPPED = Path(handover_marl.givers.__file__).parent / "policies" / "adaptive.npz"


@dataclass(frozen=True)
class AdaptiveConfig(CheckedConfig):
    """Configuration of `AdaptiveGiver`.

    Attributes:
        patience: Time without an approach after which the giver varies its handover pose (s).
        offers: Number of random offers of which the best is chosen; the first has the recorded handover pose.
        spread: Standard deviation of the random offers, in outputs of `HandoverPoseScheme` (-1 to 1).
        reach_cost: Reduction of an offer's score (0 to 1) for each meter that the person reaches farther than in the
            recording (1/m).
    """

    patience: float = bounded(6.0, 0.0, 60.0)
    offers: int = bounded(256, 1, 10_000)
    spread: float = bounded(0.5, 0.0, 10.0)
    reach_cost: float = bounded(0.5, 0.0, 100.0)


class AdaptiveGiver(ArrayGiver):
    """Giver that chooses the best of many random offers when the recorded hand is about to stop.

    An offer is a handover pose and a withdrawal; `HandoverPoseScheme` computes the motion. A network predicts from
    `OfferFeatures` whether an offer succeeds, and when. The network that ships was trained with the receivers
    `yang2021` and `dagger`, but does not observe which receiver acts. Objects without known grasps are handed over at
    the recorded pose.

    Args:
        context: Robot, task and known grasps of the objects.
        weights: Policy file of `experiments/training/train_giver_offers.py`; default: the one that ships.
        options: Fields of `AdaptiveConfig` that differ from their defaults.
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
        """Name without suffix, and hash, of the policy file, `NAME@HASH`."""
        return self._weights

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the state of `count` episodes in arrays of the factory `arrays`."""
        super().allocate(count, arrays)
        selector = LowestCostGraspSelector(self.context, count, arrays)
        self._scheme = HandoverPoseScheme(self.context, selector, count, arrays)
        self._scheme.pose_variation.timeout = self.config.patience

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row`; `seed` determines the random offers."""
        super().start(row, seed)
        self._scheme.reset(row)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: replay until an offer is chosen, then the chosen offer."""
        needed = to_numpy(self._scheme.needs_outputs(rows, observation)).nonzero()[0]
        for place in needed.tolist():
            own = {key: to_numpy(values[place : place + 1]) for key, values in observation.items()}
            offer = self._choose(self.rngs[int(rows[place])], own)
            self._scheme.set_outputs(rows[place : place + 1], self.arrays.asarray(offer[None]))
        return self._scheme.compute_actions(rows, observation)

    def _choose(self, rng: np.random.Generator, observation: Observation) -> Vectors:
        """Return the best (7,) of many random offers for an observation (1, ...), or the first if no grasp is known.

        The best has the highest score after subtraction of the cost of the person's added reach.
        """
        offers = draw_offers(rng, self.config.offers, self.config.spread)
        features, number = self._features(observation, offers), 0
        if features is not None:
            costs = self.config.reach_cost * compute_added_reaches(observation, offers)
            number = int(np.argmax(compute_offer_scores(self._network(features)) - costs))
        best: Vectors = offers[number]
        return best
