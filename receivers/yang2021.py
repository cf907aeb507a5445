"""Reactive handovers by grasp selection (Yang et al., ICRA 2021), as in HandoverSim.

Every 0.1 s the receiver ranks the object's known grasps by the distance of their standoff poses
from the pose selected last and from a preferred pose. It moves to the best reachable standoff, from
there straight to the grasp, closes the fingers and carries the object to the goal. It uses the
object's true pose and ignores the person's hand.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from handover_marl.config import check_config
from handover_marl.episode.loop import steps_from_hold_time
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIntegers, Indices
from handover_marl.policies.batch import ArrayPolicy
from handover_marl.policies.options import override_options
from handover_marl.policies.policy import Action, PolicyContext, Receiver, milliseconds_from_wait
from handover_marl.receivers.yang2021_controller import YangConfig, YangController, YangPhase

_ROW = np.zeros(1, dtype=np.int_)


class Yang2021Receiver(Receiver):
    """Receiver `yang2021`, the reactive baseline of Yang et al. (2021).

    The receiver decides every 0.1 s during the approach, every millisecond while the fingers close
    (the target is then the present configuration), and once afterwards.

    Args:
        context: The robot, the task, the objects and their grasps.
        wait: Time at the waiting pose (s); default: the time in `config`.
        config: Constants of the method.
        options: Other values of numbers in the configuration, such as `step_length=0.03`; see `YangConfig`.

    Raises:
        OptionError: `wait` or an option is out of range, or an option is unknown.

    Attributes:
        config: Constants of the method.
    """

    name = "yang2021"

    def __init__(
        self, context: PolicyContext, wait: float | None = None, config: YangConfig | None = None, **options: float
    ) -> None:
        super().__init__(context)
        config = YangConfig() if config is None else config
        check_config("config", config, YangConfig)
        self.config = override_options(config, options, "step_length")
        if wait is not None:
            self.config = replace(self.config, wait=milliseconds_from_wait(wait) / 1000.0)
        self._controller = YangController(context, self.config, 1)

    def prepare(self, object_names: Sequence[str]) -> None:
        """Read the grasps of the object that is handed over."""
        self._controller.prepare(object_names[0])

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; the receiver is deterministic."""
        self._controller.reset(_ROW)

    @property
    def wait(self) -> float:
        """Time at the waiting pose (s)."""
        return self.config.wait

    @property
    def planned_goal(self) -> npt.NDArray[np.float64] | None:
        """(2, 7) world poses of the hand link at standoff and grasp; None once fingers close."""
        selected = self._controller.selected[0]
        is_planned = self._controller.phase[0] == YangPhase.APPROACH and not np.isnan(selected).any()
        return selected if is_planned else None

    @property
    def hold_time(self) -> float:
        """Time until the next decision (s), infinite during the retreat."""
        return float(self._controller.get_hold_times(_ROW)[0])

    def act(self, observation: Observation) -> Action:
        """Return the next nine target joint positions.

        Raises:
            ResetNeededError: `reset` was not called.
        """
        action: Action = self._controller.act(_ROW, {key: values[None] for key, values in observation.items()})[0]
        return action


class Yang2021Batch(ArrayPolicy[Yang2021Receiver]):
    """Batch of `Yang2021Receiver`, whose actions equal those of single receivers to the bit."""

    def __init__(self, policy: Yang2021Receiver, count: int) -> None:
        super().__init__(policy, count)
        self._controller = YangController(policy.context, policy.config, count)

    def reset(self, row: int, seed: int | None, object_names: Sequence[str]) -> None:
        """Start an episode, and read the grasps of its object; see `PolicyBatch.reset`."""
        self._controller.prepare(object_names[0])
        super().reset(row, seed, object_names)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode; the receiver is deterministic."""
        self._controller.reset(np.array([row]))

    def decide(self, rows: Indices, observation: Observation) -> npt.NDArray[np.float32]:
        """Return the next target joint positions (r, 9) (rad, m)."""
        return self._controller.act(rows, observation)

    def count_hold_steps(self, rows: Indices) -> AnyIntegers:
        """Return the physics steps (r,) until the next decisions."""
        return np.array([steps_from_hold_time(time) for time in self._controller.get_hold_times(rows).tolist()])
