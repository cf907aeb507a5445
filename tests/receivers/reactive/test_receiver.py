"""Tests of the reactive receiver."""

import numpy as np
import pytest

from handover_marl.config import ARM_DOF
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import EpisodeCallback, run_episode
from handover_marl.episode.observations import Observation
from handover_marl.geometry.poses import transform_points
from handover_marl.grasps.graspable_object import load_obstacle
from handover_marl.planning.robot_clearance import Spheres, compute_grasp_clearances
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.reactive.config import ReactiveConfig, apply_risk
from handover_marl.receivers.reactive.controller import ReactivePhase
from handover_marl.receivers.reactive.receiver import ReactiveReceiver
from handover_marl.receivers.reactive.scene_estimate import PoseSceneEstimate
from tests.helpers.playing import observe_handover

DATA = SyntheticDataset()
CONTEXT = make_policy_context(DATA)
#: Scene of the observations, and scene of a whole episode: if the robot ignored the wood block there, its wrist would
#: be stuck on it until the episode times out.
SCENE, CROWDED_SCENE = 5, 69
TIMES = np.arange(2.0, 2.6, 0.05)


@pytest.fixture(scope="module")
def handover_observation() -> Observation:
    """Return the observation while the object is held out."""
    return observe_handover(DATA.load_scene(SCENE), 2900)


def make_reactive() -> ReactiveReceiver:
    receiver = ReactiveReceiver(CONTEXT)
    receiver.reset()
    return receiver


def observe_at(observation: Observation, seconds: float, **changes: np.ndarray) -> Observation:
    return {**observation, "time": np.array([seconds], dtype=np.float32), **changes}


class CheckingReceiver(ReactiveReceiver):
    """Receiver that checks its targets against the limits of the motors, and records phases and closed fingers."""

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self.phases: list[ReactivePhase] = []
        self.closes: list[bool] = []

    def act(self, observation: Observation) -> np.ndarray:
        before, servo = self.servo.velocity.copy(), self.config.servo
        action = super().act(observation)
        ahead = action[:ARM_DOF] - observation["robot_joint_position"][:ARM_DOF]
        lead = 1.0 / (1.0 - 0.99**50)
        assert np.abs(ahead).max() < lead * 0.05 * max(servo.max_joint_speeds) + 1e-3
        # The commanded velocity respects the maximum acceleration.
        assert np.abs(self.servo.velocity - before).max() < servo.max_acceleration * self.config.period + 1e-6
        self.phases.append(self.controller.phase)
        self.closes.append(not action[ARM_DOF:].any())
        return action


class TouchRecorder(EpisodeCallback):
    """Callback that records whether the robot touches an object that is not handed over."""

    touches = False

    def on_step(self, episode: Episode) -> None:
        self.touches |= episode.contacts.robot_touches_others


@pytest.mark.slow
def test_takes_the_object_to_the_goal_without_touching_others() -> None:
    episode, receiver, recorder = Episode("fast"), CheckingReceiver(CONTEXT), TouchRecorder()
    episode.reset(DATA.load_scene(CROWDED_SCENE))
    run_episode(episode, receiver, seed=0, callbacks=[recorder])
    assert (episode.status.label, recorder.touches) == ("success", False)
    assert episode.steps < 5000
    assert receiver.phases[0] is ReactivePhase.WAIT
    assert receiver.phases[-1] is ReactivePhase.RETREAT
    assert receiver.closes == [phase in (ReactivePhase.CLOSE, ReactivePhase.RETREAT) for phase in receiver.phases]
    episode.close()


def act(receiver: ReactiveReceiver, observation: Observation) -> np.ndarray:
    """Return the actions for an observation that stays the same for some time."""
    return np.array([receiver.act(observe_at(observation, time)) for time in TIMES])


def move_others(observation: Observation, pose: np.ndarray) -> Observation:
    """Return an observation with another pose (7,) of the objects besides the first one."""
    moved = observation["object_poses"].copy()
    moved[1:] = pose
    return {**observation, "object_poses": moved}


def test_grasps_beside_other_objects_are_preferred(handover_observation: Observation) -> None:
    far_away = np.array([5.0, 5.0, 5.0, 0.0, 0.0, 0.0, 1.0], dtype=np.float32)
    alone = {**handover_observation, "object_mask": np.array([1.0, 0.0, 0.0, 0.0, 0.0], dtype=np.float32)}
    free = make_reactive()
    actions = act(free, alone)
    np.testing.assert_array_equal(act(make_reactive(), move_others(handover_observation, far_away)), actions)
    assert free.selector.chosen is not None
    pose = handover_observation["object_poses"][0].astype(np.float64)
    # The other objects stand where the hand of the gripper would be.
    blocked = free.selector.compute_grasp_pose(free.selector.chosen, pose)
    blocked[:3] = transform_points(blocked, np.array([0.0, 0.0, -0.1]))
    observation = move_others(handover_observation, blocked)
    estimate = PoseSceneEstimate(free.arm, free.config, lambda name: load_obstacle(CONTEXT.find_object_urdf(name)))
    estimate.update(observation)
    receiver = make_reactive()
    act(receiver, observation)
    assert receiver.selector.chosen is not None
    chosen = receiver.selector.compute_grasp_pose(receiver.selector.chosen, pose)
    assert estimate.obstacles is not None
    assert compute_grasp_clearances(blocked[None], estimate.obstacles)[0] < 0.0
    assert compute_grasp_clearances(chosen[None], estimate.obstacles, receiver.config.approach.standoff)[0] > 0.0


def start_closing(handover_observation: Observation) -> tuple[ReactiveReceiver, Observation]:
    """Return a receiver whose fingers begin to close at 3 s, and its observation then."""
    receiver = make_reactive()
    act(receiver, handover_observation)
    goal = receiver.selector.chosen
    assert goal is not None
    joints = np.array([*goal.grasp_joints, 0.04, 0.04], dtype=np.float32)
    observation = observe_at(handover_observation, 3.0, robot_joint_position=joints)
    action = receiver.act(observation)
    assert receiver.controller.phase is ReactivePhase.CLOSE
    assert action[-1] == 0.0
    return receiver, observation


def test_backs_out_and_selects_another_grasp_after_a_miss(handover_observation: Observation) -> None:
    receiver, observation = start_closing(handover_observation)
    missed = receiver.selector.chosen
    assert missed is not None
    empty = observation["robot_joint_position"].copy()
    empty[ARM_DOF:] = 0.0
    receiver.act(observe_at(observation, 3.3, robot_joint_position=empty))
    assert receiver.controller.phase is ReactivePhase.CLOSE
    action = receiver.act(observe_at(observation, 3.4, robot_joint_position=empty))
    assert receiver.controller.phase is ReactivePhase.BACK_OUT
    assert action[-1] == np.float32(0.04)
    now = 3.4
    while now < 6.0 and receiver.controller.phase is ReactivePhase.BACK_OUT:
        now = round(now + 0.05, 3)
        receiver.act(observe_at(observation, now, robot_joint_position=empty))
    assert receiver.controller.phase in (ReactivePhase.APPROACH, ReactivePhase.FINAL_APPROACH)
    assert receiver.selector.chosen is not None
    assert receiver.selector.chosen.number != missed.number


def test_closes_until_the_object_is_held_after_an_early_release(handover_observation: Observation) -> None:
    receiver, observation = start_closing(handover_observation)
    fallen, joints = observation["object_poses"].copy(), observation["robot_joint_position"].copy()
    for number, fingers in enumerate((0.036, 0.0325, 0.0293, 0.0292), 1):
        assert receiver.controller.phase is ReactivePhase.CLOSE
        fallen[0, 2] -= 0.002 if number < 4 else 0.0
        joints[ARM_DOF:] = fingers
        free = {"released": np.ones(1, dtype=np.float32), "robot_joint_position": joints, "object_poses": fallen}
        action = receiver.act(observe_at(observation, 3.0 + 0.01 * number, **free))
        assert action[-1] == 0.0
        if number == 3:
            # The arm follows the object.
            rate = receiver.arm.compute_jacobian(joints[:ARM_DOF].astype(np.float64))
            assert (rate @ receiver.servo.velocity)[2] < -0.1
    assert receiver.controller.phase is ReactivePhase.RETREAT


def test_follows_the_hand_instead_of_an_object_that_is_pushed(handover_observation: Observation) -> None:
    def predict_velocity(moved: float, **changes: np.ndarray) -> np.ndarray:
        """Return the predicted velocity (3,) of an object that moves within 20 ms by a distance (m)."""
        free = make_reactive()
        scene = PoseSceneEstimate(free.arm, free.config, lambda _: Spheres(np.zeros((1, 3)), np.zeros(1)))
        poses = handover_observation["object_poses"].copy()
        scene.update(observe_at(handover_observation, 3.0))
        poses[0, 0] += moved
        scene.update(observe_at(handover_observation, 3.02, object_poses=poses, **changes))
        return scene.predict_point_twist(poses[0, :3].astype(np.float64), 0.02)[0]

    assert predict_velocity(0.002)[0] > 0.09
    np.testing.assert_allclose(predict_velocity(0.02), np.zeros(3), atol=1e-9)
    # An object that was released falls.
    assert predict_velocity(0.02, released=np.ones(1, dtype=np.float32))[0] > 0.9


def test_risk_scales_speeds_and_costs() -> None:
    careful, usual, bold = (apply_risk(ReactiveConfig(), risk) for risk in (0.0, 0.5, 1.0))
    assert usual == ReactiveConfig()
    # A careful robot slows down from farther away, and prefers grasps that are clear of the hand.
    for part, name, factor in (
        ("approach", "speed", 4.0),
        ("approach", "close_speed", 4.0),
        ("retreat", "speed", 4.0),
        ("separation", "time_constant", 0.25),
        ("selection", "clearance_cost", 0.25),
        ("selection", "partial_hold_cost", 0.25),
    ):
        values = [getattr(getattr(config, part), name) for config in (careful, usual, bold)]
        assert values == pytest.approx([values[1] / factor, values[1], factor * values[1]])
