"""Forward kinematics of the human hand by MuJoCo; quaternions are wxyz."""

import functools
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.poses import quaternion_from_matrix
from handover_marl.simulation.mujoco.quaternions import wxyz_from_xyzw

Array = npt.NDArray[np.float64]


class HandKinematics:
    """Forward kinematics of a human hand by MuJoCo, much faster than array operations.

    Args:
        urdf: Model of the hand.
        links: Numbers (k,) of the links whose poses are computed.
    """

    def __init__(self, urdf: Path, links: npt.NDArray[np.integer]) -> None:
        self._model = _compile_tree(urdf, urdf.stat().st_mtime_ns)
        self._data = mujoco.MjData(self._model)
        self._joints, self._positions, self._quaternions = self._data.qpos, self._data.xpos, self._data.xquat
        # Body 0 is the world, body 1 the base.
        self._bodies = links + 2

    def compute_poses(self, joints: Array) -> tuple[Array, Array]:
        """Compute the links' positions (k, 3) (m) and quaternions wxyz (k, 4) in the base frame.

        Args:
            joints: Positions (d,) of the moving joints (m, rad).
        """
        self._joints[:] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return self._positions[self._bodies], self._quaternions[self._bodies]

    def compute_trajectory(self, joints: Array) -> tuple[Array, Array]:
        """Compute positions (n, k, 3) (m) and quaternions wxyz (n, k, 4) for joint positions (n, d)."""
        count, place = len(joints), self._joints
        positions = np.empty((count, *self._positions.shape))
        quaternions = np.empty((count, *self._quaternions.shape))
        for number in range(count):
            place[:] = joints[number]
            mujoco.mj_kinematics(self._model, self._data)
            positions[number], quaternions[number] = self._positions, self._quaternions
        return positions[:, self._bodies], quaternions[:, self._bodies]


@functools.lru_cache(maxsize=64)
def _compile_tree(urdf: Path, mtime: int) -> "mujoco.MjModel":
    """Compile the joints of a URDF file as a MuJoCo model without shapes."""
    tree, spec = read_tree(urdf), mujoco.MjSpec()
    bodies = {-1: spec.worldbody.add_body()}
    # Links are numbered depth first, like MuJoCo's bodies.
    for number, joint in enumerate(tree.joints):
        rotation = wxyz_from_xyzw(quaternion_from_matrix(joint.rotation))
        body = bodies[number] = bodies[joint.parent].add_body(pos=joint.offset, quat=rotation)
        # MuJoCo refuses moving bodies without mass.
        body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
        if joint.kind != "fixed":
            slides = joint.kind == "prismatic"
            kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
            body.add_joint(type=kind, axis=joint.axis)
    return spec.compile()
