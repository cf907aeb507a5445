"""Scenes simulated side by side: MuJoCo's batches, one for each layout of models, and who has which row in them."""

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from handover_marl.errors import ResetNeededError
from handover_marl.sim.mujoco.breakdown import check
from handover_marl.sim.mujoco.lone_robot import LoneRobot
from handover_marl.sim.mujoco.profiler import stop_profiler
from handover_marl.sim.mujoco.scene_model import SceneModel, StageModel

Array = npt.NDArray[np.float64]

# What worlds are led by, in the order in which MuJoCo has it: servos' targets, then where bodies are put.
_CONTROLS = (mujoco.mjtState.mjSTATE_CTRL, mujoco.mjtState.mjSTATE_MOCAP_POS, mujoco.mjtState.mjSTATE_MOCAP_QUAT)
_CONTROL_SPEC = sum(int(part) for part in _CONTROLS)
_RECORDED = ("sensordata", "qpos")
# Groups without worlds that are kept: one takes some 5 MB, and 2 ms to make.
_SPARE = 8

stop_profiler()


@dataclass(frozen=True, eq=False)
class Felt:
    """What rules are told from, of one world or of n worlds (n,) with one layout and of k steps (k,) of each.

    Attributes:
        scene: A model with the worlds' layout.
        sensors: (..., s) sensor data.
        joints: (..., q) positions after the step.
    """

    scene: SceneModel
    sensors: Array
    joints: Array


class _Group:
    """Worlds of one layout.

    Args:
        scene: A model with it.
        capacity: How many worlds there may be.
    """

    def __init__(self, scene: SceneModel, capacity: int) -> None:
        self.scene = scene
        # One thread: who has more than one core to spare has as many lanes on each.
        self.batch = Batch(scene.model, capacity, nthread=1)
        self.models = [scene.model] * capacity
        self.batch.set_models(self.models)
        self.free = list(range(capacity))
        #: For what is worked out of a state without stepping.
        self.scratch = mujoco.MjData(scene.model)
        bind = self.batch.bind
        self.qpos, self.qvel, self.forces = bind("qpos"), bind("qvel"), bind("xfrc_applied")
        self.ctrl, self.mocap_pos, self.mocap_quat = bind("ctrl"), bind("mocap_pos"), bind("mocap_quat")
        self.felt = [bind(name) for name in _RECORDED]
        self._room: dict[str, Array] = {}

    def records(self, worlds: int, steps: int) -> dict[str, Array]:
        """Arrays for what is recorded of so many steps of worlds."""
        names = zip(_RECORDED, self.felt, strict=True)
        return {name: self.room(name, (worlds, steps, *one.shape[1:])) for name, one in names}

    def room(self, name: str, shape: tuple[int, ...]) -> Array:
        """An array for something: the same each time, for new memory takes its time."""
        size = math.prod(shape)
        if name not in self._room or self._room[name].size < size:
            self._room[name] = np.empty(size)
        return self._room[name][:size].reshape(shape)

    def takes(self, model: "mujoco.MjModel", row: int) -> bool:
        """Simulate a model in a row from now on, if it has the layout."""
        before = self.models[row]
        self.models[row] = model
        try:
            self.batch.set_models(self.models)
        except (ValueError, mujoco.FatalError):
            self.models[row] = before
            return False
        return True

    def release(self, row: int) -> None:
        """Take a row back, and hold on to its model no longer."""
        self.models[row] = self.scene.model
        self.batch.set_models(self.models)
        heapq.heappush(self.free, row)

    @property
    def empty(self) -> bool:
        """Whether it has no world."""
        return len(self.free) == len(self.models)


class Lanes:
    """Room for some worlds that are simulated side by side. What happens in one does not depend on the others.

    Args:
        count: How many.
        gravity: Along world z (m/s^2).
    """

    def __init__(self, count: int, gravity: float) -> None:
        self._count, self._gravity = count, gravity
        self._groups: dict[tuple[int, ...], list[_Group]] = {}
        self._robots: dict[StageModel, LoneRobot] = {}
        # Groups that had no world when they were last looked at, the one that became so first in front.
        self._spare: list[_Group] = []

    def enter(self, lane: "Lane", scene: SceneModel) -> None:
        """Give a world a row for a scene's model, at the model's own state."""
        if lane.group is None or not lane.group.takes(scene.model, lane.row):
            self.leave(lane)
            lane.group = self._group(scene)
            lane.row = heapq.heappop(lane.group.free)
        lane.begin(scene)
        lane.group.batch.reset(ids=np.array([lane.row], dtype=np.int32), stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        lane.group.batch.warning[lane.row] = 0

    def leave(self, lane: "Lane") -> None:
        """Take its row from a world."""
        group, lane.group = lane.group, None
        if group is None:
            return
        group.release(lane.row)
        if group.empty:
            self._spare = [*(one for one in self._spare if one.empty and one is not group), group]
            self._spare, dropped = self._spare[-_SPARE:], self._spare[:-_SPARE]
            for one in dropped:
                self._groups[_sizes(one.scene.model)].remove(one)

    def lone_robot(self, stage: StageModel) -> LoneRobot:
        """What a stage's robot does while it is alone, worked out for all these worlds."""
        if stage not in self._robots:
            self._robots[stage] = LoneRobot(stage)
        return self._robots[stage]

    def free_target(self, lane: "Lane") -> None:
        """Let the target object move freely under gravity, and touch table, ground and other objects."""
        group, scene = lane.running, lane.scene
        lane.released = True
        body = scene.objects[0]
        group.forces[lane.row, body, 2] = self._gravity * float(scene.model.body_mass[body])

    def _group(self, scene: SceneModel) -> _Group:
        """One whose first free row has a scene's model."""
        groups = self._groups.setdefault(_sizes(scene.model), [])
        for group in groups:
            if group.free and group.takes(scene.model, group.free[0]):
                return group
        groups.append(_Group(scene, self._count))
        return groups[-1]


def _sizes(model: "mujoco.MjModel") -> tuple[int, ...]:
    """What is equal in models of one layout."""
    return model.nq, model.nv, model.nu, model.nbody, model.ngeom, model.nbvh, model.nmocap, model.nsensordata


class Lane:
    """A world's place among others.

    Attributes:
        group: The worlds of its layout, None while it has no scene.
        row: Its row among them.
        built: Its scene's model.
        released: Whether the target object moves freely.
    """

    def __init__(self) -> None:
        self.group: _Group | None = None
        self.row = 0
        self.built: SceneModel | None = None
        self.released = False
        # Variants of the model that it has been simulated with: it may come back to them.
        self._variants: dict[tuple[bool, bool], mujoco.MjModel] = {}

    def begin(self, scene: SceneModel) -> None:
        """Take note of the scene that its row is for."""
        self.built, self.released, self._variants = scene, False, {}

    def variant(self, hand: bool) -> "mujoco.MjModel":
        """The model to simulate with now, given whether the hand is felt."""
        wanted = self.released, hand
        if wanted not in self._variants:
            self._variants[wanted] = self.scene.variants.of(*wanted)
        return self._variants[wanted]

    @property
    def running(self) -> _Group:
        """The group.

        Raises:
            ResetNeededError: There is no scene.
        """
        if self.group is None:
            raise ResetNeededError("the world is empty; call reset() first")
        return self.group

    @property
    def scene(self) -> SceneModel:
        """The scene's model."""
        if self.built is None:
            raise ResetNeededError("the world is empty; call reset() first")
        return self.built

    @property
    def qpos(self) -> Array:
        """(q,) positions, which may be written to."""
        found: Array = self.running.qpos[self.row]
        return found

    @property
    def qvel(self) -> Array:
        """(v,) velocities."""
        found: Array = self.running.qvel[self.row]
        return found

    def controls(self) -> tuple[Array, Array, Array]:
        """What leads it, which may be written to: servos' targets (u,), bodies' places (m, 3) and quaternions wxyz."""
        group, row = self.running, self.row
        return group.ctrl[row], group.mocap_pos[row], group.mocap_quat[row]

    def tell_time(self, seconds: float) -> None:
        """Say how much time has passed without it being simulated."""
        self.running.batch.bind("time")[self.row] = seconds

    def step(self) -> Felt:
        """One step with the controls as they are.

        Raises:
            SimulationError: The engine warned; its state means nothing any more.
        """
        group, rows = self.running, np.array([self.row], dtype=np.int32)
        group.batch.step(ids=rows)
        check(group.batch, rows)
        return self.felt()

    def felt(self) -> Felt:
        """What was felt in the last step."""
        return Felt(self.scene, *(array[self.row] for array in self.running.felt))

    def frames(self) -> tuple[Array, Array]:
        """Places (b, 3) and quaternions (b, 4) wxyz of all bodies as they are now."""
        scratch = self.running.scratch
        scratch.qpos[:] = self.qpos
        mujoco.mj_kinematics(self.scene.model, scratch)
        return scratch.xpos, scratch.xquat


def feel(lanes: Sequence[Lane], hands: Sequence[bool]) -> None:
    """Say for worlds of one layout whether their hands are felt from now on, or surely touch nothing."""
    group, changed = lanes[0].running, False
    for lane, hand in zip(lanes, hands, strict=True):
        model = lane.variant(hand)
        if group.models[lane.row] is not model:
            group.models[lane.row], changed = model, True
    if changed:
        group.batch.set_models(group.models)


@dataclass(frozen=True, eq=False)
class Roll:
    """Some steps of worlds of one layout, and the way back.

    Attributes:
        lanes: The worlds (n).
        felt: What was felt, (k, n, ...), until worlds of this layout are rolled again.
        controls: (n, k, c) what led them, until then, too.
        before: (n, s) their states before.
    """

    lanes: list[Lane]
    felt: Felt
    controls: Array
    before: Array

    def cut(self, number: int, steps: int) -> None:
        """Let one of the worlds have taken only so many of the steps."""
        lane = self.lanes[number]
        batch, rows = lane.running.batch, np.array([lane.row], dtype=np.int32)
        batch.state[lane.row] = self.before[number]
        batch.rollout(steps, self.controls[number, None, :steps], _CONTROL_SPEC, (), rows)


def roll(lanes: Sequence[Lane], controls: Sequence[Array]) -> Roll:
    """Simulate k steps of worlds of one layout.

    Args:
        lanes: The worlds, ordered by their rows.
        controls: (k, c) for each: servos' targets, places of the bodies that are put somewhere, their quaternions wxyz.

    Raises:
        SimulationError: The engine warned; the worlds' states mean nothing any more.
    """
    group, rows = lanes[0].running, np.array([lane.row for lane in lanes], dtype=np.int32)
    given = np.stack(controls, out=group.room("controls", (len(controls), *controls[0].shape)))
    before = group.batch.state[rows]
    room = group.records(*given.shape[:2])
    found = group.batch.rollout(given.shape[1], given, _CONTROL_SPEC, _RECORDED, rows, room)
    check(group.batch, rows)
    arrays = (found[name].swapaxes(0, 1) for name in _RECORDED)
    return Roll(list(lanes), Felt(group.scene, *arrays), given, before)
