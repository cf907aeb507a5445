"""Actor of GA-DDPG (Wang et al., CoRL 2021): from a point cloud to the next hand motion.

The actor predicts an action and, as an auxiliary output, the pose of the grasp. With the original
authors' weights, the predicted action is executed. With this library's weights, the hand moves to
the predicted grasp; a fixed rule computes each step (`handover_marl.learning.networks.approach_field`).
The rule has discontinuities that a network does not learn well.
"""

import hashlib
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as func
from torch import Tensor, nn

from handover_marl.errors import DataFormatError, DataNotFoundError, UnsafeFileError
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import read_plain_file, report_damage
from handover_marl.geometry.poses import IDENTITY
from handover_marl.geometry.rotations import normalize_quaternions
from handover_marl.learning.networks.approach_field import MAX_ROTATION, MAX_TRANSLATION, compute_approach_steps
from handover_marl.learning.networks.point_encoders import PointNetPlusPlus
from handover_marl.learning.networks.weights import (
    SavedNetwork,
    check_finite_weights,
    load_tensors,
    single_threaded_inference,
    untrained_networks,
)

#: Number of points of an input cloud, and of gripper points that the receiver may insert before them.
N_POINTS, N_FINGER_POINTS = 1024, 6
_N_HIDDEN = 256


class ActorOutput(NamedTuple):
    """Outputs of GA-DDPG's actor for B clouds, in the present frame of the hand link.

    Attributes:
        action: (B, 6) mean action: translation (m), then extrinsic xyz Euler angles (rad).
        goal: (B, 7) grasp pose of the hand link: unit quaternion wxyz, then position xyz (m).
    """

    action: Tensor
    goal: Tensor


class PolicyHead(nn.Module):
    """Head of GA-DDPG's actor: two hidden layers, then outputs for the action and the grasp pose.

    Layers are named as in GA-DDPG's code, so that the original weights can be loaded, and initialized by Xavier's
    method. The layer `log_std_linear`, for the standard deviation of the action, is not evaluated.
    """

    def __init__(self) -> None:
        super().__init__()
        self.linear1 = nn.Linear(PointNetPlusPlus.n_features + 1, _N_HIDDEN)
        self.linear2 = nn.Linear(_N_HIDDEN, _N_HIDDEN)
        self.mean = nn.Linear(_N_HIDDEN, 6)
        self.log_std_linear = nn.Linear(_N_HIDDEN, 6)
        self.extra_pred = nn.Linear(_N_HIDDEN, 7)
        self.scale: Tensor
        self.register_buffer("scale", torch.tensor([MAX_TRANSLATION] * 3 + [MAX_ROTATION] * 3), persistent=False)
        for layer in (self.linear1, self.linear2, self.mean, self.log_std_linear, self.extra_pred):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, features: Tensor, remaining: Tensor) -> ActorOutput:
        """Compute action and grasp pose for B clouds.

        Args:
            features: (B, 512) outputs of the encoder.
            remaining: (B,) numbers of decisions that remain in the approach.
        """
        features = torch.cat([features, remaining[:, None].to(features.dtype)], dim=1)
        hidden = func.relu(self.linear2(func.relu(self.linear1(features))))
        goal = self.extra_pred(hidden)
        return ActorOutput(
            torch.tanh(self.mean(hidden)) * self.scale,
            torch.cat([func.normalize(goal[:, :4], dim=-1), goal[:, 4:]], dim=-1),
        )


class GaddpgNetwork(SavedNetwork):
    """Encoder and head of GA-DDPG's actor, for the receiver `gaddpg`.

    Args:
        spare_steps: Argument of `compute_approach_steps`, which moves the hand to the predicted grasp; None executes
            the predicted action instead.
        max_steps: Number of decisions of an approach to an object at rest; None for the default of the receiver.

    Attributes:
        features: Encoder of clouds with channels xyz in the hand link's frame (m) and a zero.
        policy: Head of the actor, which computes action and grasp pose.
    """

    kind, uses_int8 = "gaddpg", True

    def __init__(self, spare_steps: int | None = None, max_steps: int | None = None) -> None:
        super().__init__()
        self.spare_steps, self.max_steps = spare_steps, max_steps
        self.features = PointNetPlusPlus()
        self.policy = PolicyHead()

    def forward(self, cloud: Tensor, remaining: Tensor) -> ActorOutput:
        """Compute action and grasp pose for B clouds.

        Args:
            cloud: (B, 4, 1024) points of the object, xyz in the hand link's frame (m) and a zero; or (B, 4, 1030) with
                six points of the gripper before them, which are not used.
            remaining: (B,) numbers of decisions that remain in the approach.
        """
        if cloud.shape[-1] != N_POINTS:
            cloud = cloud[..., N_FINGER_POINTS:]
        output: ActorOutput = self.policy(self.features(cloud), remaining)
        return output

    def predict_step(self, points: npt.NDArray[np.float64], remaining: int) -> npt.NDArray[np.float32]:
        """Return the next motion of the robot's hand for one cloud, computed in one thread.

        Args:
            points: (4, 1024 or 1030) cloud as in `forward`.
            remaining: Number of decisions that remain in the approach.

        Returns:
            (6,) translation (m) and extrinsic xyz Euler angles (rad) in the hand link's frame.
        """
        self.eval()
        with single_threaded_inference():
            output = self(torch.from_numpy(points[None].astype(np.float32)), torch.tensor([float(remaining)]))
        if self.spare_steps is None:
            return np.asarray(output.action[0].numpy())
        goal = output.goal.numpy().astype(np.float64)
        pose = np.concatenate([goal[:, 4:], normalize_quaternions(goal[:, [1, 2, 3, 0]])], axis=1)
        steps = compute_approach_steps(IDENTITY[None], pose, np.array([float(remaining)]), self.spare_steps)
        return np.asarray(steps[0], dtype=np.float32)

    def get_settings(self) -> dict[str, Any]:
        """Return the arguments as {"approach": {"spare": spare_steps} or None, "max_steps": max_steps}."""
        approach = None if self.spare_steps is None else {"spare": self.spare_steps}
        return {"approach": approach, "max_steps": self.max_steps}

    @classmethod
    def from_settings(cls, settings: dict[str, Any]) -> "GaddpgNetwork":
        """Create an untrained network from settings that `get_settings` returned."""
        approach = settings["approach"]
        return cls(None if approach is None else approach["spare"], settings["max_steps"])


_ACTOR, _FEATURES = "_actor_", "_state_feat_"
_KIND_AND_ADVICE = "checkpoint of GA-DDPG", "copy both files of its authors again"
# Names of the encoder's parts in the original code, which wraps its encoders for several GPUs.
_STAGES, _DENSE = re.compile(r"^(module\.)?encoder\.0\."), re.compile(r"^(module\.)?encoder\.1\.")


def read_gaddpg_checkpoint(path: str | Path) -> tuple[GaddpgNetwork, str]:
    """Read the network from a checkpoint of GA-DDPG's authors; run no code from it.

    Args:
        path: Folder of the checkpoint, or one of its two files.

    Returns:
        The network in evaluation mode on the CPU, and a hash of both files (8 hexadecimal digits).

    Raises:
        DataNotFoundError, DataFormatError: A file is missing or damaged.
        UnsafeFileError: A file contains more than weights.
    """
    actor, features = _find_files(Path(path).expanduser())
    (head, head_content), (encoder, encoder_content) = map(_read_weights, (actor, features))
    with untrained_networks():
        network = GaddpgNetwork()
    _load_weights(actor, network.policy, head)
    # Only the actor's encoder, with the names of `PointNetPlusPlus`.
    renamed = {_STAGES.sub("stages.", _DENSE.sub("dense.", name)): value for name, value in encoder.items()}
    own = {name: value for name, value in renamed.items() if name.startswith(("stages.", "dense."))}
    _load_weights(features, network.features, own)
    return network.eval(), hashlib.sha256(head_content + encoder_content).hexdigest()[:8]


def _find_files(path: Path) -> tuple[Path, Path]:
    """Return the files with the actor's head and with the encoders, for a checkpoint's folder or one of its files."""
    if path.is_dir():
        actors = sorted(path.glob(f"*{_ACTOR}*"))
        chosen = [file for file in actors if file.name.endswith("_latest")] or actors
        if len(chosen) != 1:
            found = ", ".join(file.name for file in chosen) or "none"
            raise DataNotFoundError(
                f"{path}: folder must contain one file named {_ACTOR!r}, got {found}; pass the path of one file"
            )
        path = chosen[0]
    name = path.name.replace(_FEATURES, _ACTOR)
    if _ACTOR not in name:
        raise DataNotFoundError(
            f"{path}: a file of GA-DDPG's checkpoint must have {_ACTOR!r} or {_FEATURES!r} in its name"
        )
    return path.with_name(name), path.with_name(name.replace(_ACTOR, _FEATURES))


def _read_weights(file: Path) -> tuple[dict[str, Tensor], bytes]:
    """Return the weights in a file by name, and the content of the file."""
    with report_damage(file, *_KIND_AND_ADVICE):
        content = read_plain_file(file)
        try:
            found = load_tensors(content)
        except pickle.UnpicklingError as error:
            raise UnsafeFileError(f"holds more than weights ({shorten_text(error)})") from error
        net = found.get("net") if isinstance(found, Mapping) else None
        if not isinstance(net, Mapping) or not all(isinstance(value, Tensor) for value in net.values()):
            raise DataFormatError("weights by name must be under 'net'")
    return {str(name): value for name, value in net.items()}, content


def _load_weights(file: Path, module: nn.Module, weights: dict[str, Tensor]) -> None:
    with report_damage(file, *_KIND_AND_ADVICE):
        module.load_state_dict(weights)
        check_finite_weights(module)
