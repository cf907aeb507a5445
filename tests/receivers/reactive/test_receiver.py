"""Tests of the reactive receiver."""

import numpy as np
import pytest

from handover_marl.config import ARM_DOF
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import call_policy, start_policy
from handover_marl.episode.observations import Observation
from handover_marl.planning.clearance import Spheres
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.reactive.config import ReactiveConfig, apply_risk
from handover_marl.receivers.reactive.controller import ReactivePhase
from handover_marl.receivers.reactive.receiver import ReactiveReceiver
from handover_marl.receivers.reactive.scene_estimate import PoseSceneEstimate
from tests.receivers.quick import QUICK_PREPARATION, observe_handover

SCENE = 5
DATA = SyntheticDataset()
QUICK = ReactiveConfig(preparation=QUICK_PREPARATION)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


def make_reactive(wait: float = 0.0, risk: float = 0.5) -> ReactiveReceiver:
    receiver = ReactiveReceiver(make_policy_context(DATA), wait, risk, QUICK)
    receiver.reset()
    return receiver


def observe_at(observation: Observation, seconds: float, **changes: np.ndarray) -> Observation:
    return {**observation, "time": np.array([seconds], dtype=np.float32), **changes}


def play_scene(receiver: ReactiveReceiver, scene: int = SCENE) -> tuple[Episode, np.ndarray, list[ReactivePhase]]:
    """Return an episode with the actions and phases of all decisions."""
    episode = Episode("fast")
    episode.reset(DATA.load_scene(scene))
    start_policy(receiver, None)
    actions, phases = [], []
    while not episode.status:
        action, due = call_policy(receiver, episode.observe(), episode.steps)
        actions.append(action)
        phases.append(receiver.phase)
        episode.advance(actions[-1], min(due, 13_000) - episode.steps)
    episode.close()
    return episode, np.array(actions), phases


@pytest.fixture(scope="module")
def handover_observation() -> Observation:
    """Return the observation while the object is held out."""
    return observe_handover(DATA.load_scene(SCENE), 2900)


@pytest.fixture(scope="module")
def played() -> tuple[ReactiveReceiver, Episode, np.ndarray, list[ReactivePhase]]:
    """Return a receiver with the episode, actions and phases of a scene."""
    receiver = make_reactive()
    return receiver, *play_scene(receiver)


@pytest.mark.slow
def test_takes_the_object_to_the_goal(
    played: tuple[ReactiveReceiver, Episode, np.ndarray, list[ReactivePhase]],
) -> None:
    _, episode, actions, phases = played
    assert episode.status.label == "success"
    assert episode.steps < 5000
    order = [phase for number, phase in enumerate(phases) if number == 0 or phase is not phases[number - 1]]
    assert order[0] is ReactivePhase.WAIT
    assert order[-1] is ReactivePhase.RETREAT
    assert ReactivePhase.CLOSE in order
    start_closing = np.array([phase in (ReactivePhase.CLOSE, ReactivePhase.RETREAT) for phase in phases])
    np.testing.assert_array_equal(actions[:, ARM_DOF:] == 0.0, np.stack([start_closing, start_closing], axis=1))


@pytest.mark.slow
def test_targets_respect_motor_limits() -> None:
    receiver = make_reactive()
    servo = receiver.config.servo
    lead = 1.0 / (1.0 - 0.99**50)
    most = lead * 0.05 * max(servo.max_joint_speeds)
    episode = Episode("fast")
    episode.reset(DATA.load_scene(SCENE))
    start_policy(receiver, None)
    before = np.zeros(ARM_DOF)
    while not episode.status:
        observation = episode.observe()
        action, due = call_policy(receiver, observation, episode.steps)
        ahead = action[:ARM_DOF] - observation["robot_joint_position"][:ARM_DOF]
        assert np.abs(ahead).max() < most + 1e-3
        # The commanded velocity respects the maximum acceleration.
        change = np.abs(receiver.servo.velocity - before).max()
        assert change < servo.max_acceleration * receiver.config.period + 1e-6
        before = receiver.servo.velocity.copy()
        episode.advance(action, min(due, 13_000) - episode.steps)
    episode.close()


def start_closing(handover_observation: Observation) -> tuple[ReactiveReceiver, Observation]:
    """Return a receiver whose fingers begin to close at 3 s, and its observation then."""
    receiver = make_reactive()
    for number in range(20):
        receiver.act(observe_at(handover_observation, 2.0 + 0.05 * number))
    goal = receiver.selector.chosen
    assert goal is not None
    joints = np.array([*goal.grasp_joints, 0.04, 0.04], dtype=np.float32)
    observation = observe_at(handover_observation, 3.0, robot_joint_position=joints)
    action = receiver.act(observation)
    assert receiver.phase is ReactivePhase.CLOSE
    assert action[-1] == 0.0
    return receiver, observation


def test_backs_out_and_selects_another_grasp_after_a_miss(handover_observation: Observation) -> None:
    receiver, observation = start_closing(handover_observation)
    missed = receiver.selector.chosen
    assert missed is not None
    empty = observation["robot_joint_position"].copy()
    empty[ARM_DOF:] = 0.0
    action = receiver.act(observe_at(observation, 3.3, robot_joint_position=empty))
    assert receiver.phase is ReactivePhase.CLOSE
    action = receiver.act(observe_at(observation, 3.4, robot_joint_position=empty))
    assert receiver.phase is ReactivePhase.BACK_OUT
    assert action[-1] == np.float32(0.04)
    now, phases = 3.4, set()
    while now < 6.0 and receiver.phase is ReactivePhase.BACK_OUT:
        now = round(now + 0.05, 3)
        receiver.act(observe_at(observation, now, robot_joint_position=empty))
        phases.add(receiver.phase)
    assert receiver.phase in (ReactivePhase.APPROACH, ReactivePhase.FINAL_APPROACH)
    chosen = receiver.selector.chosen
    assert chosen is not None
    assert chosen.number != missed.number


def observe_closing(observation: Observation, seconds: float, fingers: float, **changes: np.ndarray) -> Observation:
    """Return an observation after an early release, with both fingers at a position (m)."""
    joints = observation["robot_joint_position"].copy()
    joints[ARM_DOF:] = fingers
    free = {"released": np.ones(1, dtype=np.float32), "robot_joint_position": joints}
    return observe_at(observation, seconds, **free, **changes)


def test_closes_until_the_object_is_held_after_an_early_release(handover_observation: Observation) -> None:
    receiver, observation = start_closing(handover_observation)
    fallen = observation["object_poses"].copy()
    for number, fingers in enumerate((0.036, 0.0325, 0.0293), 1):
        fallen[0, 2] -= 0.002
        action = receiver.act(observe_closing(observation, 3.0 + 0.01 * number, fingers, object_poses=fallen))
        assert receiver.phase is ReactivePhase.CLOSE
        assert action[-1] == 0.0
    # The arm follows the object.
    rate = receiver.arm.compute_jacobian(observation["robot_joint_position"][:ARM_DOF].astype(np.float64))
    assert (rate @ receiver.servo.velocity)[2] < -0.1
    receiver.act(observe_closing(observation, 3.04, 0.0292, object_poses=fallen))
    assert receiver.phase is ReactivePhase.RETREAT


def test_follows_the_hand_instead_of_an_object_that_is_pushed(handover_observation: Observation) -> None:
    def predict_velocity(moved: float, **changes: np.ndarray) -> np.ndarray:
        """Return the predicted velocity (3,) of an object that moves within 20 ms by a distance (m)."""
        scene = PoseSceneEstimate(make_reactive().arm, QUICK, lambda _: Spheres(np.zeros((1, 3)), np.zeros(1)))
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
    for part, name in (("approach", "speed"), ("approach", "close_speed"), ("retreat", "speed")):
        values = [getattr(getattr(config, part), name) for config in (careful, usual, bold)]
        assert values == pytest.approx([values[1] / 4.0, values[1], 4.0 * values[1]])
    # A careful robot slows down from farther away, and prefers grasps that are clear of the hand.
    for part, name in (
        ("separation", "time_constant"),
        ("separation", "approach_time_constant"),
        ("selection", "clearance_cost"),
        ("selection", "partial_hold_cost"),
    ):
        values = [getattr(getattr(config, part), name) for config in (careful, usual, bold)]
        assert values == pytest.approx([4.0 * values[1], values[1], values[1] / 4.0])
