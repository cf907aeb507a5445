"""Receiver `vision`, which perceives object and hand only by the wrist camera.

A network predicts grasp candidates, and a tracker follows them, the object and the hand. Grasp selection and motion are
as in `reactive`. The receiver uses neither true poses nor object models. It infers from the motion of its fingers
whether the person has released the object.
"""

from dataclasses import replace
from pathlib import Path

from handover_marl.assets.shipped import find_vision_weights
from handover_marl.datasets.splits import SETUPS
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import SCENE_POINTCLOUD
from handover_marl.errors import OptionError
from handover_marl.execution.options import require_modules
from handover_marl.policies.policy import Action, PolicyContext, require_reset
from handover_marl.receivers.reactive.config import ReactiveConfig, apply_risk
from handover_marl.receivers.reactive.controller import ControllerReceiver
from handover_marl.receivers.vision.grasp_predictor import load_grasp_predictor
from handover_marl.receivers.vision.grasp_tracker import GraspTracker
from handover_marl.receivers.vision.mask_predictor import UNSEGMENTED, MaskPredictor, load_mask_predictor
from handover_marl.receivers.vision.scene_estimate import PointCloudSceneEstimate
from handover_marl.receivers.vision.view_planner import ViewPlanner

#: Values of `masks`: segmentation masks of the simulator, and of the shipped network.
PERFECT, PREDICTED = "perfect", "predicted"
_NEVER = 1e6  # s, longer than any episode


class VisionReceiver(ControllerReceiver):
    """Receiver that perceives object and person's hand by point clouds of the wrist camera.

    Args:
        context: The robot and the task; models and grasps of objects are not used.
        wait: Time at the waiting pose (s).
        risk: Trade-off between success rate (0) and speed (1).
        weights: Weight file of a grasp network; default: the shipped file for the setup, or that for s0 for setups of
            other data.
        masks: Segmentation of object, hand and other objects: "perfect" by the simulator, "predicted" by the shipped
            network, or the weight file of another segmentation network.
    """

    name = "vision"
    file_options = ("weights", "masks")
    non_file_values = (PERFECT, PREDICTED)
    obs_mode = SCENE_POINTCLOUD

    def __init__(
        self,
        context: PolicyContext,
        wait: float = 0.0,
        risk: float = 0.5,
        weights: str | None = None,
        masks: str = PERFECT,
    ) -> None:
        super().__init__(context, wait, apply_risk(make_vision_reactive_config(), risk))
        require_modules("receiver 'vision'", "train", "torch")
        if weights == "":
            raise OptionError(
                "weights of receiver 'vision' must name a file, got ''; leave it out for the shipped ones"
            )
        self._predictor, self._weights_hash = load_grasp_predictor(
            _find_shipped_weights("vision", context.setup, "weights") if weights is None else weights
        )
        self._predict_masks: MaskPredictor | None = None
        if masks != PERFECT:
            self.obs_mode = UNSEGMENTED
            found = _find_shipped_weights("segmentation", context.setup, "masks") if masks == PREDICTED else masks
            self._predict_masks, masks_hash = load_mask_predictor(found)
            self._weights_hash += masks_hash
        self._label = self.name if weights is None else f"{self.name}@{self._weights_hash}"
        self._scene: PointCloudSceneEstimate | None = None

    @property
    def label(self) -> str:
        """Name of the receiver, with a hash of all weights if the option `weights` was given."""
        return self._label

    @property
    def weights_hash(self) -> str:
        """Short hash of the grasp network's weights, and of those of the segmentation network if there is one."""
        return self._weights_hash

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; `seed` seeds the random selection of points for the grasp network."""
        tracker = GraspTracker(self._predictor, seed)
        view_planner = ViewPlanner(self.arm, self.servo.max_speeds)
        self._scene = PointCloudSceneEstimate(self.arm, self.config, tracker, view_planner, self._predict_masks)
        self.start_episode(self._scene)

    def act(self, observation: Observation) -> Action:
        """Return target joint positions (9,): arm (rad), fingers (m)."""
        scene, controller = require_reset(self._scene, self.name), require_reset(self.controller, self.name)
        if controller.is_grasping:
            # The camera does not see what is between the fingers, and the grasp is not changed any more.
            scene.update_robot(observation)
        else:
            tracker = scene.tracker
            self._track_selection(tracker, scene.is_settled)
            scene.update(observation)
            first = None if tracker.selected is None else 0
            self.selector.set_candidates(tracker.grasps, tracker.costs, tracker.surface, first)
        return controller.step()

    def _track_selection(self, tracker: GraspTracker, is_settled: bool) -> None:
        """Pass the last decision's selected and failed grasps to the tracker; let it add grasps if none suited."""
        selector = self.selector
        for number, until in selector.failed.items():
            tracker.add_failed(selector.grasps[number], until)
        tracker.selected = None if selector.chosen is None else selector.grasps[selector.chosen.number]
        has_no_grasp = bool(selector.failure_reason) or not len(selector.grasps)
        tracker.use_all = has_no_grasp and is_settled


def _find_shipped_weights(network: str, setup: str, option: str) -> Path:
    """Return the path of a network's shipped weights; raise `OptionError` about `option` if none ship for the setup."""
    # Setups of other data have no weights of their own, and use those of s0.
    path = find_vision_weights(network, setup if setup in SETUPS else SETUPS[0])
    if not path.is_file():
        raise OptionError(
            f"no {network} weights of receiver 'vision' ship for setup {setup!r}: train them "
            f"(experiments/training/train_{network}.py --setup {setup}) and give {option}=FILE; weights "
            "of another setup may have been trained on scenes of this setup's test split"
        )
    return path


def make_vision_reactive_config() -> ReactiveConfig:
    """Return the configuration of grasp selection and motion of the receiver `vision`.

    The configuration differs from that of `reactive` for three reasons. Decisions from camera images take longer.
    Predicted grasp qualities include the clearance to the person's hand. The visible part of an object near the gripper
    does not determine its motion well enough to approach it while it moves.
    """
    config = ReactiveConfig()
    return replace(
        config,
        near_period=0.05,
        selection=replace(
            config.selection, clearance_cost=10.0, min_clearance=0.0, hard_min_clearance=0.0, offset_delay=_NEVER
        ),
        approach=replace(config.approach, max_object_speed=0.08, max_held_still_speed=0.15, close_period=0.05),
    )
