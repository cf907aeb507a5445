"""Receiver that acts by a trained policy of LeRobot; it needs LeRobot in the same environment.

cd experiments/harnesses
handover-marl benchmark --setup s0 --receiver lerobot_receiver:LeRobotReceiver:path=FOLDER/pretrained_model
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot_env import FPS

from handover_marl.episode.observations import Observation
from handover_marl.receivers import PolicyContext, Receiver


class LeRobotReceiver(Receiver):
    """Receiver with a policy of LeRobot that observes the wrist camera's image and the robot's joints.

    Args:
        context: Robot, task and known grasps of the objects; not used.
        path: Folder with the trained policy, `pretrained_model` of a checkpoint.
    """

    name, control_period, obs_mode = "lerobot", 1.0 / FPS, "rgb"

    def __init__(self, context: PolicyContext, path: str) -> None:
        super().__init__(context)
        folder = Path(path).resolve()
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = "cpu"
        self._policy = get_policy_class(config.type).from_pretrained(folder, config=config)
        self._policy.eval()
        self._preprocess, self._postprocess = make_pre_post_processors(config, str(folder))

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; the seed is that of the policy's random numbers."""
        torch.manual_seed(0 if seed is None else seed % 2**63)
        self._policy.reset()

    @torch.inference_mode()
    def act(self, observation: Observation) -> npt.NDArray[np.float32]:
        """Return the next target joint positions (9,), 7 of the arm (rad) and 2 of the fingers (m)."""
        image = torch.from_numpy(observation["wrist_rgb"]).movedim(-1, 0).float() / 255.0
        batch = {
            "observation.images.wrist": image[None],
            "observation.state": torch.from_numpy(observation["robot_joint_position"])[None],
            "task": ["Take the object from the person's hand."],
        }
        action = self._postprocess(self._policy.select_action(self._preprocess(batch)))
        targets: npt.NDArray[np.float32] = action[0].numpy().astype(np.float32)
        return targets
