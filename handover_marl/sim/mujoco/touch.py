"""What touches what, and where the gripper is then, as arrays over any number of worlds: sensors, and reading them.

The engine's list of contacts has another length in every step and world. Sensors bring what the rules ask about into
a fixed shape inside the engine, so that one world and a thousand are read alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# So many of the strongest contacts are told of each finger and of the whole robot with the object.
_FINGER_SLOTS, _ROBOT_SLOTS = 8, 12
_FORCE = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
_POINT = _FORCE | sum(
    1 << int(field)
    for field in (
        mujoco.mjtConDataField.mjCONDATA_DIST,
        mujoco.mjtConDataField.mjCONDATA_POS,
        mujoco.mjtConDataField.mjCONDATA_NORMAL,
    )
)
_STRONGEST = 2
_AXES = (mujoco.mjtSensor.mjSENS_FRAMEXAXIS, mujoco.mjtSensor.mjSENS_FRAMEYAXIS, mujoco.mjtSensor.mjSENS_FRAMEZAXIS)


def add_touch_sensors(
    spec: "mujoco.MjSpec",
    robot: str,
    gripper: str,
    fingers: Sequence[str],
    target: str,
    hand: Sequence[str],
    supports: Sequence[str],
) -> None:
    """Let a model feel what the rules ask about.

    Args:
        spec: The model.
        robot: Body that carries the whole robot.
        gripper: Body of the robot's hand link.
        fingers: Bodies of the left and the right finger.
        target: Body of the object that is handed over.
        hand: Bodies of the hand, which touch the robot only.
        supports: Bodies that the object can lie on.
    """

    def add(name: str, first: tuple[int, str], second: str | None, what: int, slots: int) -> None:
        sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.objname = first
        if second is not None:
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, second
        sensor.intprm[:3] = [what, _STRONGEST, slots]

    body, subtree = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY
    for side, finger in zip(("left", "right"), fingers, strict=True):
        add(f"touch/{side}", (body, finger), target, _POINT, _FINGER_SLOTS)
    add("touch/robot", (subtree, robot), target, _FORCE, _ROBOT_SLOTS)
    for number, name in enumerate(hand):
        add(f"touch/hand{number}", (body, name), None, _FORCE, 1)
    for number, name in enumerate(supports):
        add(f"touch/support{number}", (body, name), target, _FORCE, 1)

    def add_frame(name: str, of: str, axes: Sequence["mujoco.mjtSensor"]) -> None:
        for kind in (mujoco.mjtSensor.mjSENS_FRAMEPOS, *axes):
            sensor = spec.add_sensor(name=f"frame/{name}/{int(kind)}", type=kind)
            sensor.objtype, sensor.objname = subtree, of

    add_frame("gripper", gripper, ())
    for side, finger in zip(("left", "right"), fingers, strict=True):
        add_frame(side, finger, _AXES)


@dataclass(frozen=True, eq=False)
class Touches:
    """What touches in each of some worlds (...).

    Attributes:
        robot_hand: (...) whether the robot touches the hand.
        robot_object_force: (...) sum of the normal forces between robot and object (N).
        supported: (...) whether the object touches table or another object.
    """

    robot_hand: npt.NDArray[np.bool_]
    robot_object_force: Array
    supported: npt.NDArray[np.bool_]


class TouchSensors:
    """Where in a model's sensor data its touch sensors are.

    Args:
        model: A model with touch sensors.
        margin: How far from each shape its surface is taken to be (m).
    """

    def __init__(self, model: "mujoco.MjModel", margin: float) -> None:
        names = [model.sensor(number).name for number in range(model.nsensor)]

        def columns(start: str) -> npt.NDArray[np.int_]:
            found = [number for number, name in enumerate(names) if name.startswith(start)]
            return np.concatenate(
                [model.sensor_adr[number] + np.arange(model.sensor_dim[number]) for number in found]
            ).astype(np.int_)

        # A point is force (3, the normal first), distance, position (3) and normal (3) from finger to object.
        points = np.stack([columns("touch/left"), columns("touch/right")]).reshape(2, _FINGER_SLOTS, -1)
        self._forces, self._distances = points[..., 0], points[..., 3]
        self._places, self._normals = points[..., 4:7], points[..., 7:10]
        # Forces come in threes.
        self._robot, self._hand, self._supports = (
            columns(f"touch/{name}")[::3] for name in ("robot", "hand", "support")
        )
        self._gripper = columns("frame/gripper")
        self._frames = np.stack([columns("frame/left"), columns("frame/right")])
        self._margin = margin

    def read(self, data: Array) -> Touches:
        """What is felt.

        Args:
            data: (..., n) sensor data of any number of worlds.
        """
        force = np.zeros(data.shape[:-1])
        for slot in self._robot:
            # One after the other, so that rounding does not depend on how many worlds are read at once.
            force = force + data[..., slot]
        return Touches(
            robot_hand=data[..., self._hand].max(axis=-1) > 0.0,
            robot_object_force=force,
            supported=data[..., self._supports].max(axis=-1) > 0.0,
        )

    def finger_forces(self, data: Array) -> Array:
        """(..., 2, 8) normal forces of the left and the right finger on the object (N); 0 where there is no contact."""
        return data[..., self._forces]

    def gripper_place(self, data: Array) -> Array:
        """(..., 3) where the robot's hand link was when the contacts were found (m)."""
        return data[..., self._gripper]

    def finger_frames(self, data: Array) -> tuple[Array, Array]:
        """(..., 2, 3) where the fingers' frames were then (m), and (..., 2, 3, 3) their axes, as columns."""
        frames = data[..., self._frames]
        axes = frames[..., 3:].reshape(*frames.shape[:-1], 3, 3)
        return frames[..., :3], np.swapaxes(axes, -1, -2)

    def finger_points(self, data: Array, origins: Array, turns: Array) -> Array:
        """(..., 2, 8, 3) where the left and the right finger are touched, in their frames (m).

        Only those with a force mean something.

        Args:
            data: (..., n) sensor data.
            origins: (..., 2, 3) where the fingers' frames were when these contacts were found (m).
            turns: (..., 2, 3, 3) their axes, as columns.
        """
        # A contact is told in the middle between the two surfaces.
        outwards = self._margin - 0.5 * data[..., self._distances]
        points = data[..., self._places] + data[..., self._normals] * outwards[..., None]
        away, axes = points - origins[..., None, :], turns[..., None, :, :]
        # Written out, so that rounding does not depend on how many are worked out at once.
        return np.asarray(
            away[..., 0, None] * axes[..., 0, :]
            + away[..., 1, None] * axes[..., 1, :]
            + away[..., 2, None] * axes[..., 2, :]
        )
