"""Receiver `reactive`, which follows the object, may change the grasp, and keeps clear of the person's hand."""

from collections.abc import Sequence

from handover_marl.config import check_config
from handover_marl.episode.observations import Observation
from handover_marl.grasps.graspable_object import load_graspable_object, load_obstacle
from handover_marl.policies.policy import Action, PolicyContext, override_options, require_reset
from handover_marl.receivers.reactive.config import ReactiveConfig, apply_risk
from handover_marl.receivers.reactive.controller import ControllerReceiver
from handover_marl.receivers.reactive.scene_estimate import PoseSceneEstimate


class ReactiveReceiver(ControllerReceiver):
    """Receiver that follows the moving object; it observes the true poses of objects and hand, and the release.

    While the person lifts the object, the gripper moves to a standoff in front of a grasp at the predicted handover
    pose. It approaches the grasp in a straight line relative to the moving object, closes the fingers, backs out and
    tries again if the fingers hold nothing, and carries the object to the goal once the person has released it.

    Args:
        context: The robot, the objects and their grasps.
        wait: Time at the waiting pose (s).
        risk: Trade-off between success rate (0) and speed (1).
        config: Configuration of the receiver for a risk of 0.5.
        options: Numbers of the configuration, such as `approach_standoff=0.1`. They are set after `risk` is applied;
            see `override_options`.
    """

    name = "reactive"

    def __init__(
        self,
        context: PolicyContext,
        wait: float = 0.0,
        risk: float = 0.5,
        config: ReactiveConfig | None = None,
        **options: float,
    ) -> None:
        config = ReactiveConfig() if config is None else config
        check_config("config", config, ReactiveConfig)
        config = apply_risk(config, risk)
        super().__init__(context, wait, override_options(config, options))
        self._object_name = ""
        self._scene: PoseSceneEstimate | None = None

    def prepare(self, object_names: Sequence[str]) -> None:
        """Validate the grasps of the first object, which is handed over, and load the other objects."""
        for name in object_names[:1]:
            load_graspable_object(self.context, name, self.config.preparation)
        for name in object_names[1:]:
            load_obstacle(self.context.find_object_urdf(name))

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; `seed` is ignored, since the receiver is deterministic."""
        self._object_name = ""
        find_urdf, names = self.context.find_object_urdf, self.context.object_names
        self._scene = PoseSceneEstimate(self.arm, self.config, lambda name: load_obstacle(find_urdf(name)), names)
        self.start_episode(self._scene)

    def act(self, observation: Observation) -> Action:
        """Return target joint positions (9,): arm (rad), fingers (m)."""
        scene, controller = require_reset(self._scene, self.name), require_reset(self.controller, self.name)
        scene.update(observation)
        if scene.object_name != self._object_name:
            self._object_name = scene.object_name
            self.selector.set_object(load_graspable_object(self.context, self._object_name, self.config.preparation))
        return controller.step()
