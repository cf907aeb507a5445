"""How a policy in a Stable-Baselines3 file was trained, as far as that can be read without unpickling."""

import base64
import binascii
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.datasets.pickled_grasps import unpickle_plain
from handover_marl.episode.observations import giver_observation_space, observation_space
from handover_marl.errors import DataFormatError
from handover_marl.models.panda import LOWER_LIMITS, UPPER_LIMITS

# The Panda's joints stop 4 degrees beyond the limits that targets keep, where an arm at speed does arrive (rad, m).
_BEYOND = 0.075
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?inf")


@dataclass(frozen=True, eq=False)
class TrainingRecord:
    """How a policy was trained.

    Attributes:
        low: Lower bounds of its action space, or None if the file does not say.
        high: Upper bounds.
        control_period: How long its actions held (s), or None.
        squashed_by_policy: Whether the policy squashes its outputs by itself (gSDE).
        last_seen: The last observations of training by name, or None.
    """

    low: npt.NDArray[np.float64] | None
    high: npt.NDArray[np.float64] | None
    control_period: float | None
    squashed_by_policy: bool
    last_seen: dict[str, npt.NDArray[Any]] | None

    def check(self, path: Path, agent: str, space: spaces.Box) -> None:
        """Refuse what was trained on anything but the plain environment.

        Raises:
            DataFormatError: Its actions or observations were something else.
        """
        if self.low is None or self.high is None:
            raise DataFormatError(f"{path}: it does not say what its actions were; export the policy as .npz")
        same = self.low.shape == space.shape and np.allclose(self.low, space.low, atol=1e-4)
        if not (same and np.allclose(self.high, space.high, atol=1e-4)):
            raise DataFormatError(
                f"{path}: it was trained on actions from {self.low.tolist()} to {self.high.tolist()}, a {agent}'s are "
                "joint targets or deviations in physical units; train without RescaleAction, or on an encoded "
                "environment and export the policy as .npz"
            )
        if self.squashed_by_policy:
            raise DataFormatError(f"{path}: policies that squash their outputs (gSDE) are not supported")
        if self.last_seen is not None and not _as_observed(self.last_seen):
            raise DataFormatError(
                f"{path}: it was trained on normalised observations (VecNormalize), whose statistics are not in the "
                "file; train without, or on an encoded environment and export the policy as .npz"
            )


def read_training(path: Path, about: Mapping[str, Any]) -> TrainingRecord:
    """Read the record out of a model's `data`."""
    space = about.get("action_space")
    space = space if isinstance(space, dict) else {}
    period = space.get("control_period")
    arguments = about.get("policy_kwargs")
    return TrainingRecord(
        low=_numbers(space.get("low")),
        high=_numbers(space.get("high")),
        control_period=float(period) if isinstance(period, (int, float)) and not isinstance(period, bool) else None,
        squashed_by_policy=isinstance(arguments, dict) and arguments.get("squash_output") is True,
        last_seen=_last_seen(about.get("_last_obs")),
    )


def _numbers(text: object) -> npt.NDArray[np.float64] | None:
    """The numbers of an array that is written out in words."""
    if not isinstance(text, str) or len(text) > 10_000:
        return None
    return np.array([float(number) for number in _NUMBER.findall(text)])


def _last_seen(value: object) -> dict[str, npt.NDArray[Any]] | None:
    """The last observations, read by a reader that knows arrays only; None where there are none."""
    if not isinstance(value, dict) or not isinstance(value.get(":serialized:"), str):
        return None
    try:
        found = unpickle_plain(base64.b64decode(value[":serialized:"]))
    except (DataFormatError, binascii.Error, ValueError):
        return None
    return _unflattened(found) if isinstance(found, np.ndarray) else found


def _unflattened(flat: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]] | None:
    """Flat observations by name again, in the order in which Gymnasium flattens them."""
    for space in (observation_space(), giver_observation_space()):
        if flat.ndim == 2 and flat.shape[1] == spaces.flatdim(space):
            names = list(space.spaces)
            sizes = [spaces.flatdim(space[name]) for name in names]
            parts = np.split(flat, np.cumsum(sizes)[:-1], axis=1)
            shapes = [(len(flat), *(space[name].shape or ())) for name in names]
            return {name: part.reshape(shape) for name, part, shape in zip(names, parts, shapes, strict=True)}
    return None


def _as_observed(seen: dict[str, npt.NDArray[Any]]) -> bool:
    """Whether these are observations as the environment makes them.

    Flags are 0 or 1, classes whole numbers, quaternions of length 1, and joints within their limits; means taken out,
    all but some of these are otherwise.
    """
    for name in ("object_mask", "hand_present", "released"):
        if name in seen and not np.isin(seen[name], (0.0, 1.0)).all():
            return False
    if "object_mask" in seen and not (seen["object_mask"][:, 0] == 1.0).all():
        return False
    if (
        "object_classes" in seen
        and not ((seen["object_classes"] == np.rint(seen["object_classes"])) & (seen["object_classes"] >= 0.0)).all()
    ):
        return False
    if "time" in seen and (seen["time"] < 0.0).any():
        return False
    if "robot_joint_position" in seen:
        joints = seen["robot_joint_position"]
        low, high = np.array(LOWER_LIMITS) - _BEYOND, np.array(UPPER_LIMITS) + _BEYOND
        if not ((joints >= low) & (joints <= high)).all():
            return False
    if "gripper_pose" in seen:
        return bool(np.allclose(np.linalg.norm(seen["gripper_pose"][:, 3:], axis=1), 1.0, atol=1e-3))
    return True
