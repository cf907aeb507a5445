"""Creation of batches of features and action schemes; user-defined ones are called episode by episode."""

from collections.abc import Callable
from typing import Any

from handover_marl.geometry.arrays import NUMPY_ARRAYS, ArrayFactory
from handover_marl.learning.action_scheme import ActionScheme
from handover_marl.learning.batch.features import FEATURE_BATCHES, FeatureBatch, SequentialFeatureBatch
from handover_marl.learning.batch.giver_schemes import DeviationBatch, HandoverPoseBatch
from handover_marl.learning.batch.grasp_selector import LowestCostGraspSelectorBatch
from handover_marl.learning.batch.receiver_schemes import (
    CartesianDeltaBatch,
    GraspServoBatch,
    JointDeltaBatch,
    JointPositionBatch,
)
from handover_marl.learning.batch.schemes import RawSchemeBatch, SchemeBatch, SequentialSchemeBatch
from handover_marl.learning.encodings.custom_features import FeaturesLike
from handover_marl.learning.encodings.custom_schemes import SchemeLike
from handover_marl.learning.features import make_features
from handover_marl.learning.giver_schemes import DeviationScheme, HandoverPoseScheme, RawGiverScheme
from handover_marl.learning.receiver_schemes import (
    CartesianDeltaScheme,
    GraspServoScheme,
    JointDeltaScheme,
    JointPositionScheme,
    RawReceiverScheme,
)
from handover_marl.learning.schemes import make_scheme
from handover_marl.policies.policy import PolicyContext

_SCHEME_BATCHES: dict[
    type[ActionScheme], Callable[[Any, LowestCostGraspSelectorBatch, int, ArrayFactory], SchemeBatch]
] = {
    RawGiverScheme: RawSchemeBatch,
    RawReceiverScheme: RawSchemeBatch,
    JointPositionScheme: JointPositionBatch,
    JointDeltaScheme: JointDeltaBatch,
    CartesianDeltaScheme: CartesianDeltaBatch,
    GraspServoScheme: GraspServoBatch,
    DeviationScheme: DeviationBatch,
    HandoverPoseScheme: HandoverPoseBatch,
}


def make_feature_batch(
    agent: str,
    choice: FeaturesLike,
    context: PolicyContext,
    selector: LowestCostGraspSelectorBatch,
    count: int,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> FeatureBatch:
    """Make an agent's features for n episodes: built-in features work on arrays, others episode by episode.

    Args:
        agent: "giver" or "receiver".
        choice: Features, see `features.make_features`.
        context: Robot, task and known grasps of the objects.
        selector: Selector of grasps.
        count: Number n of episodes.
        arrays: Creator of the arrays.
    """
    known = FEATURE_BATCHES[agent].get(choice) if isinstance(choice, str) else None
    if known is not None:
        return known(context, selector, count, arrays)
    return SequentialFeatureBatch([make_features(agent, choice, context) for _ in range(count)], arrays)


def find_scheme_batch(
    scheme: ActionScheme, selector: LowestCostGraspSelectorBatch, count: int, arrays: ArrayFactory = NUMPY_ARRAYS
) -> SchemeBatch | None:
    """Return the batch of a built-in action scheme for n episodes; None for a user-defined one.

    Args:
        scheme: Scheme of a single episode; its parameters apply to all episodes.
        selector: Selector of grasps.
        count: Number n of episodes.
        arrays: Creator of the arrays.
    """
    batch = _SCHEME_BATCHES.get(type(scheme))
    return None if batch is None else batch(scheme, selector, count, arrays)


def make_scheme_batch(
    agent: str,
    choice: SchemeLike,
    context: PolicyContext,
    selector: LowestCostGraspSelectorBatch,
    count: int,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> SchemeBatch:
    """Make an agent's action scheme for n episodes: built-in schemes work on arrays, others episode by episode.

    Args:
        agent: "giver" or "receiver".
        choice: Action scheme, see `schemes.make_scheme`.
        context: Robot, task and known grasps of the objects.
        selector: Selector of grasps.
        count: Number n of episodes.
        arrays: Creator of the arrays.
    """
    first = make_scheme(agent, choice, context)
    batch = find_scheme_batch(first, selector, count, arrays)
    if batch is not None:
        return batch
    others = (make_scheme(agent, choice, context) for _ in range(count - 1))
    return SequentialSchemeBatch([first, *others], arrays)
