"""Simulation of one scene with two policies, to be rendered."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from handover_marl.config import CameraConfig
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import derive_robot_seed, run_episode
from handover_marl.evaluation.config import build_configs, set_dataset
from handover_marl.evaluation.replays import format_replay_facts
from handover_marl.policies.reference import PolicyLike, parse_policy
from handover_marl.visualization.replay_page import build_replay_page
from handover_marl.visualization.replay_recorder import ReplayRecorder


class ScenePlayer:
    """Simulation of one scene with a receiver and a giver.

    Args:
        scene_id: Number of the scene.
        receiver: The robot's policy.
        giver: The person's policy.
        options: Fields of `EvaluationConfig` and `ExecutionConfig` by name.

    Attributes:
        config: Configuration of the evaluation.
        execution: Configuration of the execution.
        dataset: Dataset of the scene.
        scene: The scene.
        receiver: Policy of the receiver.
        episode: Episode of the scene, reset by `play`.
    """

    def __init__(self, scene_id: int, receiver: PolicyLike, giver: PolicyLike, options: Any) -> None:
        self.config, self.execution = build_configs(None, options, receiver=receiver, giver=giver)
        self.dataset = self.config.open_dataset()
        self.scene = self.dataset.load_scene(scene_id)
        self._references = {
            agent: parse_policy(agent, getattr(self.config, agent), self.execution.trust)
            for agent in ("receiver", "giver")
        }
        self.receiver, self._giver = (
            reference.make(self.dataset, self.config.world_config) for reference in self._references.values()
        )
        self.episode = Episode(self.config.physics, self.config.world_config, wrist_camera=self.config.camera)

    def play(self, until: int | Callable[[], bool] | None, callbacks: Sequence[EpisodeCallback] = ()) -> int:
        """Simulate the scene and return the number of physics steps.

        Args:
            until: Number of physics steps, or a function that returns whether to stop; default: the
                end of the episode.
            callbacks: Callbacks of the episode.
        """
        seed = self.config.seed
        self.episode.reset(self.scene, derive_robot_seed(seed, self.scene))
        run_episode(self.episode, self.receiver, self._giver, seed=seed, until=until, callbacks=callbacks)
        return self.episode.steps

    def build_replay_page(self, until: int | None, camera: CameraConfig | None) -> bytes:
        """Simulate the scene to its end, or for `until` steps, and return its replay page."""
        recorder = ReplayRecorder(self.receiver)
        self.play(until, [recorder])
        config, dataset = self.config, self.dataset
        resolved = {
            agent: reference.resolve(dataset, config.world_config) for agent, reference in self._references.items()
        }
        config = set_dataset(replace(config, **resolved), dataset)  # type: ignore[arg-type]
        facts = format_replay_facts(config, dataset.describe_models(self.scene.info.scene_id))
        return build_replay_page(recorder.log, facts, camera).encode()

    def close(self) -> None:
        """Free the memory and the physics client of the simulation."""
        self.episode.close()
