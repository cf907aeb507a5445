"""Balls around the shapes of models, to tell what is too far apart to touch."""

import functools
from pathlib import Path

import numpy as np

from handover_marl.models.kinematic_tree import Sphere
from handover_marl.models.poses import inverse_transform_points
from handover_marl.sim.bullet.client import connect, load_urdf


def link_spheres(urdf: Path) -> dict[int, Sphere]:
    """A ball around the collision shapes of every link that has some; -1 is the base.

    Raises:
        SimulationError: The model cannot be loaded.
    """
    return _measure(urdf, urdf.stat().st_mtime_ns)


@functools.cache
def _measure(urdf: Path, changed: int) -> dict[int, Sphere]:
    # In a server of its own: whether a model was measured before must not show in the world's body numbers.
    client = connect()
    body = load_urdf(client, urdf, useFixedBase=True)
    spheres = {}
    for link in range(-1, client.getNumJoints(body)):
        if not client.getCollisionShapeData(body, link):
            continue
        lower, upper = np.array(client.getAABB(body, link))
        if link < 0:
            # The base was loaded with its link frame at the origin.
            pose = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        else:
            state = client.getLinkState(body, link, computeForwardKinematics=1)
            pose = np.array([*state[4], *state[5]])
        center = inverse_transform_points(pose, (lower + upper) / 2.0)
        spheres[link] = Sphere(center, float(np.linalg.norm(upper - lower)) / 2.0)
    client.close()
    return spheres
