"""Benchmark for vla-eval, the evaluation harness of vision-language-action models: one task per scene.

    cd experiments/harnesses
    PYTHONPATH=. vla-eval run --config vla_eval.yaml

A model gets the image of the wrist camera, the joints of the robot and the task in words. It returns a motion of the
Panda's hand link in the link's own frame, and whether to close the gripper; see
`handover_marl.learning.encodings.schemes.CartesianDeltaScheme`.
"""

from typing import Any

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import GRIPPER_CLOSE_POS, IMAGE_RGB, LANGUAGE, POSITION_DELTA, ROTATION_AA, STATE_JOINT, DimSpec

import handover_marl
from handover_marl import EpisodeStatus, make_action_scheme
from handover_marl.config import TIME_STEP, ProtocolConfig
from handover_marl.evaluation.demonstrations.convert import describe_task


class HandoverBenchmark(StepBenchmark):
    """Benchmark of handovers from a giver that replays recordings.

    Args:
        setup: Official setup, s0 to s3.
        split: Split of the setup: train, val or test.
        control_period: Time between two actions (s).
        physics: Physics: exact, fast or mujoco.
        config: Other arguments of `handover_marl.parallel_env`.
    """

    render_backends = frozenset({"cpu"})

    def __init__(
        self, setup: str = "s0", split: str = "test", control_period: float = 0.1, physics: str = "exact", **config: Any
    ) -> None:
        super().__init__()
        self._handover = handover_marl.parallel_env(
            setup=setup, split=split, control_period=control_period, physics=physics, obs_mode="rgb", **config
        )
        self._env = handover_marl.control_agent(self._handover, "receiver", "replay", api="gymnasium")
        self._scheme = make_action_scheme("receiver", "cartesian_delta", self._handover.policy_context)
        self._max_steps = round(ProtocolConfig().horizon_steps * TIME_STEP / control_period)
        self._observation: dict[str, Any] = {}

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Return no environment variables, since images are rendered on the CPU."""
        return {}

    def get_tasks(self) -> list[dict[str, Any]]:
        return [{"name": f"scene {scene}", "scene_id": scene} for scene in self._handover.scene_ids]

    def reset(self, task: dict[str, Any]) -> dict[str, Any]:
        self._scheme.reset()
        self._observation, _ = self._env.reset(seed=0, options={"scene_id": task["scene_id"]})
        self._recorder.record_video(self._observation["wrist_rgb"])
        return self._observation

    def step(self, action: dict[str, Any]) -> StepResult:
        """Apply `actions` (7,) in [-1, 1] for a control period: six move the hand link, the last closes the gripper."""
        self._scheme.set_outputs(np.asarray(action["actions"], dtype=np.float64).reshape(-1)[:7])
        targets = self._scheme.compute_action(self._observation)
        self._observation, reward, terminated, truncated, info = self._env.step(targets)
        self._recorder.record_video(self._observation["wrist_rgb"])
        return StepResult(self._observation, reward, terminated or truncated, info)

    def make_obs(self, raw_obs: dict[str, Any], task: dict[str, Any]) -> dict[str, Any]:
        return {
            "images": {"wrist": raw_obs["wrist_rgb"]},
            "state": raw_obs["robot_joint_position"],
            "task_description": describe_task(self._handover.object_names[0]),
        }

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """Return whether the episode was a success, and whether the robot touched the person (1 or 0)."""
        status = EpisodeStatus(step_result.info["status"])
        return {"success": status == EpisodeStatus.SUCCESS, "contact": float(EpisodeStatus.HUMAN_CONTACT in status)}

    def get_metric_keys(self) -> dict[str, str]:
        return {"success": "mean", "contact": "mean"}

    def get_metadata(self) -> dict[str, Any]:
        return {"max_steps": self._max_steps}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        return {"wrist": IMAGE_RGB, "state": STATE_JOINT, "language": LANGUAGE}

    def get_hold_action(self, last_action: dict[str, Any] | None) -> dict[str, Any]:
        """Return the action that does not move the arm and keeps the gripper as it is."""
        gripper = 0.0 if last_action is None else float(np.asarray(last_action["actions"]).reshape(-1)[6])
        return {"actions": np.array([0.0] * 6 + [gripper], dtype=np.float32)}

    def cleanup(self) -> None:
        self._env.close()
