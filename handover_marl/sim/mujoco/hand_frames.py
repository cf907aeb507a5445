"""Where the links of a hand are, worked out by MuJoCo on a model of nothing but its joints."""

import functools
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.poses import quaternion_from_matrix

Array = npt.NDArray[np.float64]


class HandFrames:
    """Forward kinematics of a URDF's links, many times as fast for one posture as arrays are.

    Args:
        urdf: The hand's model.
        links: (k,) numbers of the links that are asked about.
    """

    def __init__(self, urdf: Path, links: npt.NDArray[np.integer]) -> None:
        self._model = _joint_model(urdf, urdf.stat().st_mtime_ns)
        self._data = mujoco.MjData(self._model)
        self._joints, self._places, self._turns = self._data.qpos, self._data.xpos, self._data.xquat
        # Body 0 is the world, body 1 the base.
        self._bodies = links + 2

    def poses(self, joints: Array) -> tuple[Array, Array]:
        """Places (k, 3) (m) and quaternions (k, 4) wxyz of the links in the base's frame.

        Args:
            joints: (d,) positions of the moving joints (m, rad).
        """
        self._joints[:] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return self._places[self._bodies], self._turns[self._bodies]


@functools.lru_cache(maxsize=64)
def _joint_model(urdf: Path, changed: int) -> "mujoco.MjModel":
    tree, spec = read_tree(urdf), mujoco.MjSpec()
    bodies = {-1: spec.worldbody.add_body()}
    # Links are numbered depth first, as MuJoCo numbers bodies.
    for number, joint in enumerate(tree.joints):
        turn = np.roll(quaternion_from_matrix(joint.turn), 1)
        body = bodies[number] = bodies[joint.parent].add_body(pos=joint.offset, quat=turn)
        # Bodies that move must weigh something.
        body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
        if joint.kind != "fixed":
            slides = joint.kind == "prismatic"
            kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
            body.add_joint(type=kind, axis=joint.axis)
    return spec.compile()
