"""The reactive receiver."""

import numpy as np
import pytest

from handover_marl import receivers
from handover_marl.benchmarking.runner import benchmark
from handover_marl.config import ARM_JOINTS
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.clock import PolicyClock
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError, ResetNeededError
from handover_marl.policies.context import context_of
from handover_marl.receivers import WAITING_JOINTS
from handover_marl.receivers.reactive.grasps import GraspTrials
from handover_marl.receivers.reactive.reactive_config import ReactiveConfig, with_risk
from handover_marl.receivers.reactive.reactive_receiver import Phase, ReactiveReceiver
from handover_marl.sim.grasp_trial import TrialConfig
from handover_marl.testing import check_receiver

SCENE = 5
DATA = SyntheticDataset()
# Trials so short that all stand them: what they find out is tested where they are.
QUICK = ReactiveConfig(
    trials=GraspTrials(
        tilts=(),
        aside=(),
        around=(),
        slip=1.0,
        held_time=0.15,
        free_time=0.002,
        trial=TrialConfig(close_time=0.15, shake_time=0.002),
    )
)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


class Quick(ReactiveReceiver):
    name = "quick"

    def __init__(self, context: receivers.PolicyContext) -> None:
        super().__init__(context, config=QUICK)


def reactive(wait: float = 0.0, risk: float = 0.5) -> ReactiveReceiver:
    receiver = ReactiveReceiver(context_of(DATA), wait, risk, QUICK)
    receiver.reset()
    return receiver


def at(observation: Observation, seconds: float, **changes: np.ndarray) -> Observation:
    return {**observation, "time": np.array([seconds], dtype=np.float32), **changes}


def played(receiver: ReactiveReceiver, scene: int = SCENE) -> tuple[Episode, np.ndarray, list[Phase]]:
    """An episode with the actions of its decisions and what the receiver was doing."""
    episode, clock = Episode("fast"), PolicyClock(receiver)
    episode.reset(DATA.scene(scene))
    clock.reset(None)
    actions, phases = [], []
    while not episode.status:
        actions.append(clock.ask(episode.observe(), episode.steps))
        phases.append(receiver.phase)
        episode.advance(actions[-1], min(clock.due, 13_000) - episode.steps)
    episode.close()
    return episode, np.array(actions), phases


@pytest.fixture(scope="module")
def offered() -> Observation:
    """What there is to see when the object is held out."""
    episode = Episode("fast")
    episode.reset(DATA.scene(SCENE))
    episode.advance(np.array(WAITING_JOINTS, dtype=np.float32), 2900)
    observation = episode.observe()
    episode.close()
    return observation


def test_keeps_what_the_benchmark_relies_on() -> None:
    check_receiver(Quick, dataset=DATA)


def test_takes_the_object_to_the_goal() -> None:
    episode, actions, phases = played(reactive())
    assert episode.status.label == "success"
    assert episode.steps < 5000
    order = [phase for number, phase in enumerate(phases) if number == 0 or phase is not phases[number - 1]]
    assert order[0] is Phase.WAIT
    assert order[-1] is Phase.RETREAT
    assert Phase.CLOSE in order
    closing = np.array([phase in (Phase.CLOSE, Phase.RETREAT) for phase in phases])
    np.testing.assert_array_equal(actions[:, ARM_JOINTS:] == 0.0, np.stack([closing, closing], axis=1))


def test_whole_episodes_repeat() -> None:
    receiver = reactive()
    first, actions, _ = played(receiver)
    again, others, _ = played(receiver)
    fresh, third, _ = played(reactive())
    assert first.steps == again.steps == fresh.steps
    np.testing.assert_array_equal(actions, others)
    np.testing.assert_array_equal(actions, third)


def test_waits(offered: Observation) -> None:
    receiver = reactive(wait=1.0)
    assert receiver.wait == 1.0
    assert reactive().wait == 0.0
    joints = np.array(WAITING_JOINTS, dtype=np.float32)
    for number in range(20):
        action = receiver.act(at(offered, 0.05 * number, robot_joint_position=joints))
        np.testing.assert_allclose(action, joints, atol=1e-6)
        assert receiver.phase is Phase.WAIT


def test_targets_never_jump() -> None:
    receiver = reactive()
    servo = receiver.config.servo
    episode, _, _ = played(receiver)
    assert episode.status
    lead = 1.0 / (1.0 - 0.99**50)
    most = lead * 0.05 * max(servo.speeds)
    episode.reset(DATA.scene(SCENE))
    receiver.reset()
    clock = PolicyClock(receiver)
    clock.reset(None)
    before = np.zeros(ARM_JOINTS)
    while not episode.status:
        observation = episode.observe()
        action = clock.ask(observation, episode.steps)
        ahead = action[:ARM_JOINTS] - observation["robot_joint_position"][:ARM_JOINTS]
        assert np.abs(ahead).max() < most + 1e-3
        # The commanded velocity changes by no more than acceleration allows.
        change = np.abs(receiver.commanded_velocity - before).max()
        assert change < servo.acceleration * receiver.config.period + 1e-6
        before = receiver.commanded_velocity.copy()
        episode.advance(action, min(clock.due, 13_000) - episode.steps)
    episode.close()


def closing(offered: Observation) -> tuple[ReactiveReceiver, Observation]:
    """A receiver whose fingers begin to close at 3 s, and what it then sees."""
    receiver = reactive()
    for number in range(20):
        receiver.act(at(offered, 2.0 + 0.05 * number))
    choice = receiver.choice.chosen
    assert choice is not None
    joints = np.array([*choice.goal, 0.04, 0.04], dtype=np.float32)
    seen = at(offered, 3.0, robot_joint_position=joints)
    action = receiver.act(seen)
    assert receiver.phase is Phase.CLOSE
    assert action[-1] == 0.0
    return receiver, seen


def test_opens_backs_out_and_tries_another_grasp_after_a_miss(offered: Observation) -> None:
    receiver, seen = closing(offered)
    missed = receiver.choice.chosen
    assert missed is not None
    empty = seen["robot_joint_position"].copy()
    empty[ARM_JOINTS:] = 0.0
    action = receiver.act(at(seen, 3.3, robot_joint_position=empty))
    assert receiver.phase is Phase.CLOSE
    action = receiver.act(at(seen, 3.4, robot_joint_position=empty))
    assert receiver.phase is Phase.BACK
    assert action[-1] == np.float32(0.04)
    now, phases = 3.4, set()
    while now < 6.0 and receiver.phase is Phase.BACK:
        now = round(now + 0.05, 3)
        receiver.act(at(seen, now, robot_joint_position=empty))
        phases.add(receiver.phase)
    assert receiver.phase in (Phase.APPROACH, Phase.REACH)
    chosen = receiver.choice.chosen
    assert chosen is not None
    assert chosen.number != missed.number


def test_tries_again_when_the_person_does_not_let_go(offered: Observation) -> None:
    receiver, seen = closing(offered)
    held = seen["robot_joint_position"].copy()
    held[ARM_JOINTS:] = 0.02
    receiver.act(at(seen, 3.7, robot_joint_position=held))
    assert receiver.phase is Phase.CLOSE
    receiver.act(at(seen, 3.9, robot_joint_position=held))
    assert receiver.phase is Phase.BACK


def test_retreats_once_the_person_lets_go(offered: Observation) -> None:
    receiver, seen = closing(offered)
    free = {"released": np.ones(1, dtype=np.float32)}
    action = receiver.act(at(seen, 3.2, **free))
    assert receiver.phase is Phase.RETREAT
    assert action[-1] == 0.0
    # Straight back out of the hand first.
    hand = seen["gripper_pose"]
    assert np.isfinite(hand).all()
    assert np.abs(receiver.commanded_velocity).max() > 0.05


def test_stays_without_known_grasps(offered: Observation) -> None:
    receiver = reactive()
    classes = np.zeros(5, dtype=np.float32)
    classes[0] = 1.0
    for number in range(10):
        receiver.act(at(offered, 3.0 + 0.05 * number, object_classes=classes))
    assert receiver.phase is Phase.WAIT


def test_needs_a_reset(offered: Observation) -> None:
    with pytest.raises(ResetNeededError, match="reactive"):
        ReactiveReceiver(context_of(DATA), config=QUICK).act(offered)


@pytest.mark.parametrize("risk", [-0.1, 1.1, "half", True])
def test_risk_is_a_share(risk: object) -> None:
    with pytest.raises(OptionError, match="risk"):
        with_risk(ReactiveConfig(), risk)  # type: ignore[arg-type]


def test_risk_trades_room_for_speed() -> None:
    careful, usual, bold = (with_risk(ReactiveConfig(), risk) for risk in (0.0, 0.5, 1.0))
    assert usual == ReactiveConfig()
    assert careful.approach.speed < usual.approach.speed < bold.approach.speed
    assert careful.grasps.lack > usual.grasps.lack > bold.grasps.lack


def test_name_with_options() -> None:
    receiver = receivers.make("reactive:wait=1.5,risk=0.2", DATA)
    assert isinstance(receiver, ReactiveReceiver)
    assert receiver.wait == 1.5
    assert receiver.config == with_risk(ReactiveConfig(), 0.2)


def test_plays_in_exact_physics() -> None:
    report = benchmark("s0", "train", Quick, scenes=[SCENE], dataset="synthetic", physics="exact", progress=False)
    (episode,) = report.episodes
    assert episode.steps > 1000
