"""Contact sensors of MuJoCo models, and conversion of their data to contacts.

The length of MuJoCo's list of contacts changes from step to step and differs between worlds. Sensors inside the engine
collect the strongest contacts in arrays of fixed shape. One world and many are therefore read in the same way.
"""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.config import ProtocolConfig
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, get_namespace, is_tensor
from handover_marl.geometry.panda import FINGER_LINKS, HAND_LINK
from handover_marl.simulation.world import NO_POINTS, Contacts, RolloutContacts, find_points_in_grasp_region

Array = npt.NDArray[np.float64]

# Number of strongest contacts that are recorded: of each finger with the target object, of the whole robot with it, and
# of each link of the human hand with the robot.
_FINGER_SLOTS, _ROBOT_SLOTS, _HAND_SLOTS = 8, 12, 4
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


def add_contact_sensors(
    spec: "mujoco.MjSpec", robot: str, objects: Sequence[str], table: str | None = None, hand: Sequence[str] = ()
) -> None:
    """Add sensors to a MuJoCo model for the contacts and poses that the task's rules need.

    Args:
        spec: Model to extend.
        robot: Name of the robot's base body.
        objects: Names of the objects' bodies, the target first.
        table: Name of the table's body, if there is one.
        hand: Names of the human hand's bodies, which collide with the robot only.
    """
    target, *others = objects

    def add(name: str, first: tuple[int, str], second: str | None, fields: int, slots: int) -> None:
        sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.objname = first
        if second is not None:
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, second
        sensor.intprm[:3] = [fields, _STRONGEST, slots]

    body, subtree = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY
    for side, finger in zip(("left", "right"), FINGER_LINKS, strict=True):
        add(f"touch/{side}", (body, finger), target, _POINT, _FINGER_SLOTS)
    add("touch/robot", (subtree, robot), target, _FORCE, _ROBOT_SLOTS)
    for number, name in enumerate(hand):
        add(f"touch/hand{number}", (body, name), None, _FORCE, _HAND_SLOTS)
    for number, name in enumerate(others):
        add(f"touch/other{number}", (subtree, robot), name, _FORCE, 1)
    for number, name in enumerate([*([] if table is None else [table]), *others]):
        add(f"touch/support{number}", (body, name), target, _FORCE, 1)

    def add_frame(name: str, of: str, axes: Sequence["mujoco.mjtSensor"]) -> None:
        for kind in (mujoco.mjtSensor.mjSENS_FRAMEPOS, *axes):
            sensor = spec.add_sensor(name=f"frame/{name}/{int(kind)}", type=kind)
            sensor.objtype, sensor.objname = subtree, of

    add_frame("gripper", HAND_LINK, ())
    for side, finger in zip(("left", "right"), FINGER_LINKS, strict=True):
        add_frame(side, finger, _AXES)


class ContactSensors:
    """Layout of a model's contact sensors in its sensor data, and computation of contacts from these data.

    Args:
        model: Model with contact sensors.
        margin: Distance of each hull's surface from its vertices (m).
        height_index: Index in `qpos` of the target object's world z.
    """

    def __init__(self, model: "mujoco.MjModel", margin: float, height_index: int) -> None:
        names = [model.sensor(number).name for number in range(model.nsensor)]

        def list_columns(prefix: str) -> npt.NDArray[np.int_]:
            found = [number for number, name in enumerate(names) if name.startswith(prefix)]
            columns = [model.sensor_adr[number] + np.arange(model.sensor_dim[number]) for number in found]
            return np.concatenate(columns or [[]]).astype(np.int_)

        # A contact is force (3, the normal first), distance, position (3) and normal (3) from finger to object.
        points = np.stack([list_columns("touch/left"), list_columns("touch/right")]).reshape(2, _FINGER_SLOTS, -1)
        self._forces, self._distances = points[..., 0], points[..., 3]
        self._positions, self._normals = points[..., 4:7], points[..., 7:10]
        # A force has three components, the normal first.
        self._robot, self._hand, self._others, self._supports = (
            list_columns(f"touch/{name}")[::3] for name in ("robot", "hand", "other", "support")
        )
        self._gripper = list_columns("frame/gripper")
        self._frames = np.stack([list_columns("frame/left"), list_columns("frame/right")])
        self._margin, self._height_index = margin, height_index

    def move_to(self, arrays: ArrayFactory) -> "ContactSensors":
        """Return a copy of this layout for sensor data in the namespace and on the device of an array factory."""
        moved = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(moved, name, arrays.asarray(value))
        return moved

    def compute_contacts(self, data: Array, qpos: Array, released: bool) -> Contacts:
        """Return the contacts of one world in one physics step.

        Args:
            data: Sensor data (s,).
            qpos: Joint positions (q,) after the step.
            released: Whether the person has released the object; before, `object_supported` is False.
        """
        force, hand_forces = float(self._sum_robot_forces(data)), data[self._hand]
        touches_hand = bool((hand_forces > 0.0).any())
        left, right = NO_POINTS, NO_POINTS
        if force > 0.0:
            points, pressed = self.compute_finger_points(data), data[self._forces] > 0.0
            left, right = (own[is_pressed] for own, is_pressed in zip(points, pressed, strict=True))
        x, y, z = data[self._gripper].tolist()
        return Contacts(
            robot_touches_hand=touches_hand,
            robot_touches_object=force > 0.0,
            finger_points=(left, right),
            object_supported=released and bool((data[self._supports] > 0.0).any()),
            object_height=float(qpos[self._height_index]),
            gripper_position=(x, y, z),
            robot_object_force=force,
            robot_hand_force=float(hand_forces.sum()) if touches_hand else 0.0,
            robot_touches_others=bool((data[self._others] > 0.0).any()),
        )

    def compute_rollout_contacts(self, data: AnyArray, qpos: AnyArray, rules: ProtocolConfig) -> RolloutContacts:
        """Return the contacts of n worlds in k physics steps.

        Args:
            data: Sensor data (k, n, s).
            qpos: Joint positions (k, n, q) after the steps.
            rules: Rules of the protocol, of which only the grasp region of the fingers is used.
        """
        xp, touching = get_namespace(data), self._sum_robot_forces(data) > 0.0
        fingers, inside = (xp.zeros_like(data[..., :2], dtype=xp.bool) for _ in range(2))
        # With NumPy, points are computed only for the few steps with contact.
        steps = ... if is_tensor(data) else touching
        if steps is ... or touching.any():
            near = data[steps]
            fingers[steps] = self.find_touching_fingers(near)
            in_region = find_points_in_grasp_region(self.compute_finger_points(near), rules)
            inside[steps] = xp.any((near[..., self._forces] > 0.0) & in_region, axis=-1)
        return RolloutContacts(
            robot_touches_hand=xp.max(data[..., self._hand], axis=-1) > 0.0,
            robot_touches_object=touching,
            fingers_touch=fingers,
            in_grasp_region=inside,
            object_supported=xp.max(data[..., self._supports], axis=-1) > 0.0,
            object_height=qpos[..., self._height_index],
            gripper_position=data[..., self._gripper],
        )

    def find_touching_fingers(self, data: AnyArray) -> AnyArray:
        """Return from sensor data (..., s) whether the left and the right finger touch the target object, (..., 2)."""
        return get_namespace(data).any(data[..., self._forces] > 0.0, axis=-1)

    def compute_finger_points(self, data: AnyArray) -> AnyArray:
        """Compute the points (..., 2, 8, 3) of up to 8 contacts of each finger with the object from data (..., s).

        Points are in the frame of the finger (m), float32. Points of contacts without a normal force are invalid.
        """
        frames = data[..., self._frames]
        origins, columns = frames[..., :3], frames[..., 3:].reshape(*frames.shape[:-1], 3, 3)
        # MuJoCo places a contact in the middle between both surfaces.
        outwards = self._margin - 0.5 * data[..., self._distances]
        points = data[..., self._positions] + data[..., self._normals] * outwards[..., None]
        offsets, axes = points - origins[..., None, :], columns.swapaxes(-1, -2)[..., None, :, :]
        # Written out, so that rounding does not depend on the number of worlds.
        local = (
            offsets[..., 0, None] * axes[..., 0, :]
            + offsets[..., 1, None] * axes[..., 1, :]
            + offsets[..., 2, None] * axes[..., 2, :]
        )
        xp = get_namespace(data)
        return xp.astype(local, xp.float32)

    def _sum_robot_forces(self, data: AnyArray) -> AnyArray:
        """Return the sum (...) of up to 12 normal forces between robot and target object (N) in data (..., s)."""
        if is_tensor(data):
            return data[..., self._robot].sum(-1)
        force = np.zeros(data.shape[:-1])
        if data[..., self._robot].any():
            for slot in self._robot:
                # Summed one by one, so that rounding does not depend on the number of worlds.
                force = force + data[..., slot]
        return force
