"""Receiver that acts by a policy trained with LeRobot.

    cd experiments/harnesses
    handover-marl benchmark --setup s0 --receiver lerobot_receiver:LeRobotReceiver:folder=CHECKPOINT/pretrained_model

LeRobot must be installed in the same virtual environment.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot_env import FPS, join_environment_state

from handover_marl.episode.observations import Observation
from handover_marl.evaluation.demonstrations.convert import describe_task
from handover_marl.receivers import PolicyContext, Receiver


class LeRobotReceiver(Receiver):
    """Receiver that acts by a policy of LeRobot.

    The policy observes the robot's joints and, as in its training, the wrist camera's image or the true state, or both.

    Args:
        context: Robot, task and known grasps of the objects; not used.
        folder: Folder with the trained policy, `pretrained_model` of a checkpoint.
        fps: Frame rate of the data of its training (1/s), at which it decides.
    """

    name = "lerobot"
    file_options = ("folder",)

    def __init__(self, context: PolicyContext, folder: str, fps: float = FPS) -> None:
        super().__init__(context)
        self.control_period = 1.0 / fps  # type: ignore[misc]
        path = Path(folder).resolve()
        config = PreTrainedConfig.from_pretrained(path)
        config.device = "cpu"
        parts = {"rgb": "observation.images.wrist", "state": "observation.environment_state"}
        self.obs_mode = "+".join(part for part, feature in parts.items() if feature in config.input_features)
        self._policy = get_policy_class(config.type).from_pretrained(path, config=config)
        self._policy.eval()
        self._preprocess, self._postprocess = make_pre_post_processors(config, str(path))
        self._task = ""

    def prepare(self, object_names: Sequence[str]) -> None:
        """Store the task in words, with the name of the object that is handed over."""
        self._task = describe_task(object_names[0])

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; `seed` seeds the policy's random numbers."""
        torch.manual_seed(0 if seed is None else seed % 2**63)
        self._policy.reset()

    @torch.inference_mode()
    def act(self, observation: Observation) -> npt.NDArray[np.float32]:
        """Return the next target joint positions (9,), 7 of the arm (rad) and 2 of the fingers (m)."""
        batch = {"observation.state": torch.from_numpy(observation["robot_joint_position"])[None], "task": [self._task]}
        if "rgb" in self.obs_mode:
            image = torch.from_numpy(observation["wrist_rgb"]).movedim(-1, 0).float() / 255.0
            batch["observation.images.wrist"] = image[None]
        if "state" in self.obs_mode:
            batch["observation.environment_state"] = torch.from_numpy(join_environment_state(observation))[None]
        action = self._postprocess(self._policy.select_action(self._preprocess(batch)))
        targets: npt.NDArray[np.float32] = action[0].numpy().astype(np.float32)
        return targets
