"""Training conditions of a Stable-Baselines3 model, read from its JSON without unpickling."""

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

from handover_marl.datasets.restricted_pickle import unpickle_arrays
from handover_marl.episode.observations import giver_observation_space, state_space
from handover_marl.errors import DataFormatError
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS

# The Panda's joints stop 4 degrees beyond the limits of joint targets (rad, m).
_JOINT_STOP_MARGIN = 0.075
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?inf")
_FLAGS = ("object_mask", "hand_present", "released")

Observations = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Sb3TrainingRecord:
    """Training conditions of a Stable-Baselines3 model.

    Attributes:
        low: Lower bounds of the action space, or None if not recorded.
        high: Upper bounds of the action space, or None if not recorded.
        control_period: Time between two decisions (s), or None if not recorded.
        squashed_by_policy: Whether the policy squashes its outputs itself (gSDE).
        last_observations: Last batch of observations in training, as arrays by name; None if not
            recorded.
        encoding: Agent, features and action scheme of the encoded environment, or None.
    """

    low: npt.NDArray[np.float64] | None
    high: npt.NDArray[np.float64] | None
    control_period: float | None
    squashed_by_policy: bool
    last_observations: Observations | None
    encoding: tuple[str, str, str] | None = None

    def check(self, path: Path, agent: str, space: spaces.Box) -> None:
        """Check that the policy was trained on unscaled observations and actions.

        Raises:
            DataFormatError: Actions were rescaled or squashed, or observations were normalized.
        """
        if self.low is None or self.high is None:
            raise DataFormatError(f"{path}: the file does not record the action bounds; export the policy as .npz")
        has_bounds = self.low.shape == space.shape and np.allclose(self.low, space.low, atol=1e-4)
        if not (has_bounds and np.allclose(self.high, space.high, atol=1e-4)):
            raise DataFormatError(
                f"{path}: action bounds of the {agent} must be {space.low.tolist()} to {space.high.tolist()}, got "
                f"{self.low.tolist()} to {self.high.tolist()}; train without "
                "RescaleAction, or on an encoded environment"
            )
        if self.squashed_by_policy:
            raise DataFormatError(f"{path}: policies that squash their outputs (gSDE) are not supported")
        if self.last_observations is not None and not _are_raw_observations(self.last_observations):
            raise DataFormatError(
                f"{path}: the policy was trained on normalized observations (VecNormalize), whose statistics are not "
                "in the file; write the model with handover_marl.export_policy, which includes them"
            )


def read_training_record(about: Mapping[str, Any]) -> Sb3TrainingRecord:
    """Read the training conditions from the JSON `data` of a Stable-Baselines3 model."""
    space = about.get("action_space")
    space = space if isinstance(space, dict) else {}
    period, arguments = space.get("control_period"), about.get("policy_kwargs")
    return Sb3TrainingRecord(
        low=_parse_numbers(space.get("low")),
        high=_parse_numbers(space.get("high")),
        control_period=float(period) if isinstance(period, (int, float)) and not isinstance(period, bool) else None,
        squashed_by_policy=isinstance(arguments, dict) and arguments.get("squash_output") is True,
        last_observations=_read_observations(about.get("_last_obs")),
        encoding=_read_encoding(space.get("encoding")),
    )


def _read_encoding(value: object) -> tuple[str, str, str] | None:
    """Return agent, features and action scheme that an encoded environment wrote into its action space."""
    if not isinstance(value, dict):
        return None
    names = [value.get(key) for key in ("agent", "features", "actions")]
    agent, features, actions = (name if isinstance(name, str) else "" for name in names)
    return (agent, features, actions) if agent and features and actions else None


def _parse_numbers(text: object) -> npt.NDArray[np.float64] | None:
    """Return the numbers of an array that was printed as text."""
    if not isinstance(text, str) or len(text) > 10_000:
        return None
    return np.array([float(number) for number in _NUMBER.findall(text)])


def _read_observations(value: object) -> Observations | None:
    """Read pickled observations with a reader that accepts arrays only; None if there are none."""
    if not isinstance(value, dict) or not isinstance(value.get(":serialized:"), str):
        return None
    try:
        found = unpickle_arrays(base64.b64decode(value[":serialized:"]))
    except (DataFormatError, binascii.Error, ValueError):
        return None
    return _unflatten(found) if isinstance(found, np.ndarray) else found


def _unflatten(flat: npt.NDArray[Any]) -> Observations | None:
    """Split flat observations (n, size) by name, in the order in which Gymnasium flattens them."""
    for space in (state_space(), giver_observation_space()):
        if flat.ndim == 2 and flat.shape[1] == spaces.flatdim(space):
            sizes = [spaces.flatdim(part) for part in space.values()]
            parts = np.split(flat, np.cumsum(sizes)[:-1], axis=1)
            return {
                name: part.reshape(len(flat), *(space[name].shape or ()))
                for name, part in zip(space, parts, strict=True)
            }
    return None


def _are_raw_observations(observations: Observations) -> bool:
    """Return whether values are as the environment makes them, which normalization would change.

    Flags are 0 or 1, classes whole numbers, quaternions of length 1, joints within their limits.
    """
    if any(name in observations and not np.isin(observations[name], (0.0, 1.0)).all() for name in _FLAGS):
        return False
    if "object_mask" in observations and not (observations["object_mask"][:, 0] == 1.0).all():
        return False
    if "object_classes" in observations:
        classes = observations["object_classes"]
        if not ((classes == np.rint(classes)) & (classes >= 0.0)).all():
            return False
    if "time" in observations and (observations["time"] < 0.0).any():
        return False
    if "robot_joint_position" in observations:
        joints = observations["robot_joint_position"]
        low, high = np.array(LOWER_LIMITS) - _JOINT_STOP_MARGIN, np.array(UPPER_LIMITS) + _JOINT_STOP_MARGIN
        if not ((joints >= low) & (joints <= high)).all():
            return False
    if "gripper_pose" in observations:
        return bool(np.allclose(np.linalg.norm(observations["gripper_pose"][:, 3:], axis=1), 1.0, atol=1e-3))
    return True
