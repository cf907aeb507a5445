"""Short validations of grasps and short planning for tests of receivers."""

from collections.abc import Iterator

import pytest

from handover_marl.grasps.validation import GraspPreparationConfig
from handover_marl.planning import goal_set, planner
from handover_marl.simulation.grasp_validation_config import GraspValidationConfig

# The simulated validations are so short that all grasps pass them.
QUICK_PREPARATION = GraspPreparationConfig(
    tilts=(),
    lateral_offsets=(),
    release_offsets=(),
    max_slip=1.0,
    held_time=0.15,
    free_time=0.002,
    validation=GraspValidationConfig(close_time=0.15, shake_time=0.002),
)


def shorten_planning(patch: pytest.MonkeyPatch) -> None:
    """Plan with few goals and few steps of optimization."""
    patch.setattr(goal_set, "_IK_SEEDS", goal_set._IK_SEEDS[:3])
    patch.setattr(planner, "_N_SELECTION_STEPS", 4)
    patch.setattr(planner, "_N_FIXED_GOAL_STEPS", 2)


@pytest.fixture(scope="module", autouse=True)
def short_planning() -> Iterator[None]:
    """Shorten planning in the tests of a module that imports this."""
    with pytest.MonkeyPatch.context() as patch:
        shorten_planning(patch)
        yield
