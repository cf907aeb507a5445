"""Point matching: how far apart two poses of a gripper are, as mean L1 distance of points on it (m).

As GA-DDPG has it: the mean over six points of the sum over x, y and z. Its loss of actions takes points that are turned
by a quarter against the gripper's, its loss of goals takes them as they are.
"""

import torch
from torch import Tensor

# The wrist twice, and two on each finger, along y as the Panda's fingers are; twice the same for a grasp turned by
# half a turn, which is the same grasp.
_ALONG_Y = torch.tensor(
    [
        [0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0],
        [0.0, 0.053, 0.075],
        [0.0, -0.053, 0.075],
        [0.0, 0.053, 0.105],
        [0.0, -0.053, 0.105],
    ]
)
_ALONG_X = _ALONG_Y[:, [1, 0, 2]]
_TURNED = _ALONG_Y * torch.tensor([-1.0, -1.0, 1.0])


def action_losses(steps: Tensor, wanted: Tensor) -> Tensor:
    """(B,) of steps (B, 6): translation (m) and Euler angles (rad) about x, y, z, axes at rest."""
    points = _ALONG_X.to(steps.device)
    return _apart(
        _moved(points, _turns(steps[:, 3:]), steps[:, :3]), _moved(points, _turns(wanted[:, 3:]), wanted[:, :3])
    )


def goal_losses(goals: Tensor, wanted: Tensor) -> Tensor:
    """(B,) of goals as networks tell them, quaternion wxyz, then xyz (m), to poses (B, 7), xyz and quaternion xyzw.

    A gripper turned by half a turn about its approach is as good.
    """
    points, turned = _ALONG_Y.to(goals.device), _TURNED.to(goals.device)
    told = _moved(points, _rotations(goals[:, :4]), goals[:, 4:])
    turns = _rotations(wanted[:, [6, 3, 4, 5]])
    both = [_apart(told, _moved(way, turns, wanted[:, :3])) for way in (points, turned)]
    return torch.minimum(*both)


def _apart(points: Tensor, others: Tensor) -> Tensor:
    return (points - others).abs().sum(dim=-1).mean(dim=-1)


def _moved(points: Tensor, turns: Tensor, shifts: Tensor) -> Tensor:
    """(B, 6, 3) points (6, 3) turned by (B, 3, 3) and moved by (B, 3)."""
    return points @ turns.transpose(1, 2) + shifts[:, None]


def _turns(angles: Tensor) -> Tensor:
    """(B, 3, 3) of Euler angles (B, 3): about x, then y, then z, axes at rest."""
    (sa, sb, sc), (ca, cb, cc) = angles.sin().unbind(dim=1), angles.cos().unbind(dim=1)
    rows = [
        torch.stack([cb * cc, sb * sa * cc - ca * sc, sb * ca * cc + sa * sc], dim=1),
        torch.stack([cb * sc, sb * sa * sc + ca * cc, sb * ca * sc - sa * cc], dim=1),
        torch.stack([-sb, cb * sa, cb * ca], dim=1),
    ]
    return torch.stack(rows, dim=1)


def _rotations(quaternions: Tensor) -> Tensor:
    """(B, 3, 3) of unit quaternions (B, 4) wxyz."""
    w, x, y, z = quaternions.unbind(dim=1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1),
    ]
    return torch.stack(rows, dim=1)
