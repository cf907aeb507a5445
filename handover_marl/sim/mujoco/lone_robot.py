"""The robot while nothing that the giver moves is near it: simulated with table and ground alone, and only once.

Every episode begins so, most with the same way from the start to the waiting pose. What a robot does in the same state
with the same target is the same to the bit, so ways are remembered.
"""

from collections import OrderedDict
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from handover_marl.config import TIME_STEP
from handover_marl.sim.mujoco.breakdown import check
from handover_marl.sim.mujoco.chain import XYZW
from handover_marl.sim.mujoco.scene_model import StageModel

Array = npt.NDArray[np.float64]

# What a robot's future depends on beside its target.
_STATE = ("qpos", "qvel", "qacc_warmstart")
# Ways that are remembered: one of 200 steps takes 100 kB, and a wait of two seconds has ten.
_REMEMBERED = 256


@dataclass(frozen=True, eq=False)
class RobotPath:
    """What a robot does in n steps: (n + 1, ...) rows, before the first step and after each.

    Attributes:
        joints: (n + 1, 9) positions (rad, m).
        speeds: (n + 1, 9).
        warm: (n + 1, 9) accelerations, from which the engine begins to look for the next ones.
        balls: (n, b, 3) the middles of the balls around its links before each step (m).
    """

    joints: Array
    speeds: Array
    warm: Array
    balls: Array


class LoneRobot:
    """Works out what a robot does.

    Args:
        stage: The robot, and what stands still around it.
    """

    def __init__(self, stage: StageModel) -> None:
        self._stage = stage
        self._batch = Batch(stage.model, 1, nthread=1)
        self._state = [self._batch.bind(name) for name in _STATE]
        self._paths: OrderedDict[tuple[bytes, int], RobotPath] = OrderedDict()

    def start(self, joints: npt.ArrayLike) -> RobotPath:
        """A path of no steps: the robot's joints (9,) at first, at rest (rad, m)."""
        at = np.array([joints], dtype=np.float64)
        return RobotPath(at, np.zeros(at.shape), np.zeros(at.shape), np.zeros((0, 0, 3)))

    def go_on(self, path: RobotPath, row: int, target: list[float], steps: int, passed: int) -> RobotPath:
        """What follows after so many steps of a path.

        Args:
            path: What it did before.
            row: How many steps of that.
            target: Nine joint targets (rad, m).
            steps: How many steps.
            passed: Steps since the episode's start, for errors to tell.

        Raises:
            SimulationError: The engine warned.
        """
        state = np.stack([path.joints[row], path.speeds[row], path.warm[row], target])
        wanted = state.tobytes(), steps
        if wanted not in self._paths:
            self._paths[wanted] = self._simulated(state, steps, passed)
            if len(self._paths) > _REMEMBERED:
                self._paths.popitem(last=False)
        self._paths.move_to_end(wanted)
        return self._paths[wanted]

    def _simulated(self, state: Array, steps: int, passed: int) -> RobotPath:
        batch = self._batch
        for here, part in zip(self._state, state[:-1], strict=True):
            here[0] = part
        batch.bind("time")[0], batch.warning[0] = TIME_STEP * passed, 0
        controls = np.repeat(state[None, -1:], steps, axis=1)
        found = batch.rollout(steps, controls, int(mujoco.mjtState.mjSTATE_CTRL), (*_STATE, "xpos", "xquat"))
        check(batch, np.zeros(1, dtype=np.int32))
        joints, speeds, warm = (
            np.concatenate([first[None], found[name][0]]) for first, name in zip(state[:-1], _STATE, strict=True)
        )
        links = np.concatenate([found["xpos"][0], found["xquat"][0][..., XYZW]], axis=-1)[:, self._stage.links]
        return RobotPath(joints, speeds, warm, self._stage.clearance.balls(links))
