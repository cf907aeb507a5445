from pathlib import Path
from typing import Any

import numpy as np
import pettingzoo
import pytest

import handover_marl
from handover_marl import parallel_env
from handover_marl.config import CameraConfig, PandaConfig, ProtocolConfig, WorldConfig
from handover_marl.envs.agents import AGENTS
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.rewards import SHAPED, RewardWeights
from handover_marl.episode.referee import RELEASE_REASONS, EpisodeStatus, ReleaseReason
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.errors import (
    ActionError,
    DataNotFoundError,
    OptionError,
    ResetNeededError,
    SceneError,
    SimulationError,
    UnknownNameError,
)
from handover_marl.geometry.panda import UPPER_LIMITS
from handover_marl.givers import make_giver_action

START = np.array(PandaConfig().start_joints, dtype=np.float32)
REPLAY = np.zeros(GIVER_ACTION_SIZE, dtype=np.float32)

SYNTHETIC: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val"}

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def make(data: Path, **options: Any) -> HandoverEnv:
    return handover_marl.parallel_env(data_dir=data, **{"split": "val", **options})


def both(receiver: Any, giver: Any = REPLAY) -> dict[str, Any]:
    return {"giver": giver, "receiver": receiver}


@pytest.mark.parametrize("kind", ["parallel", "aec"])
def test_pettingzoos_registry(kind: str) -> None:
    env = pettingzoo.make(kind, "HandoverMARL/Handover-v0", **SYNTHETIC, max_cycles=5)
    env.reset(seed=1)
    assert set(env.possible_agents) == {"giver", "receiver"}
    assert env.unwrapped.config.max_cycles == 5
    env.close()


def test_observations_are_in_their_spaces_and_not_shared(fake_data: Path) -> None:
    env = make(fake_data)
    observations, _ = env.reset(options={"scene_id": 14})
    for agent in env.agents:
        assert env.observation_space(agent).contains(observations[agent])
    np.testing.assert_array_equal(observations["giver"]["object_mask"], [1, 1, 1, 0, 0])
    np.testing.assert_array_equal(observations["giver"]["object_classes"], [3, 11, 21, 0, 0])
    np.testing.assert_array_equal(observations["giver"]["robot_joint_position"], START)
    observations["giver"]["robot_joint_position"][:] = 9.0
    np.testing.assert_array_equal(observations["receiver"]["robot_joint_position"], START)
    assert env.state_space.contains(env.state())


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (both(START[:8]), r"shape \(8,\).*expected \(9,\)"),
        (both(np.where(np.arange(9) == 4, np.nan, START)), "component 4 is nan"),
        (both([1e300, *[0.0] * 8]), "component 0 is inf"),
        (both(START, np.full(8, np.nan)), "giver"),
        (START, "must be a dict by agent"),
    ],
)
def test_bad_actions_leave_the_world_alone(fake_data: Path, actions: Any, message: str) -> None:
    env = make(fake_data)
    env.reset(options={"scene_id": np.int64(9)})
    before = env.state()
    with pytest.raises(ActionError, match=message):
        env.step(actions)
    np.testing.assert_array_equal(before, env.state())
    assert env.step(both(START))[4]["giver"]["steps"] == 100


def test_receiver_actions_are_not_clipped(fake_data: Path) -> None:
    env = make(fake_data)
    seen = {}
    for offset in (0.0, 1.0):
        env.reset(options={"scene_id": 9})
        limit = np.array(UPPER_LIMITS, dtype=np.float32)
        seen[offset] = env.step(both(limit + np.float32(offset)))[0]["receiver"]["robot_joint_velocity"]
    assert np.abs(seen[0.0] - seen[1.0]).max() > 1e-3


@pytest.mark.parametrize(
    ("field", "value"),
    [("setup", "s7"), ("split", "dev"), ("dataset", "coco"), ("physics", "quick"), ("render_mode", "ascii")]
    + [("obs_mode", "lidar"), ("renderer", "cycles"), ("camera_model", "wrong"), ("robot", "ur5")]
    + [("camera_noise", "kinect")]
    + [("control_period", value) for value in (0, 0.0005, float("nan"), "fast")]
    + [("max_cycles", value) for value in (0, 2.0, True)],
)
def test_wrong_fields_are_named(fake_data: Path, field: str, value: Any) -> None:
    with pytest.raises((UnknownNameError, OptionError), match=field):
        make(fake_data, **{field: value})


def test_other_user_errors(fake_data: Path) -> None:
    with pytest.raises(DataNotFoundError, match="synthetic"):
        handover_marl.parallel_env(dataset="dexycb")
    with pytest.raises(OptionError, match="data_dir"):
        handover_marl.parallel_env(dataset="synthetic", data_dir=fake_data)
    env = make(fake_data, render_mode="rgb_array")
    for call in (env.state, env.render):
        with pytest.raises(ResetNeededError):
            call()
    for own in (env, handover_marl.control_agent(env, api="gymnasium"), handover_marl.encode(env)):
        with pytest.raises(OptionError, match="seed must be an integer from 0 on or None, got -1"):
            own.reset(seed=-1)
    with pytest.raises(OptionError, match="options"):
        env.reset(options=[1])  # type: ignore[arg-type]
    for scene_id in (5, "9", 9.5, np.array([9, 14])):
        with pytest.raises(SceneError, match="s0 val" if isinstance(scene_id, int) else "by its number"):
            env.reset(options={"scene_id": scene_id})


def test_numbers_of_numpy_are_numbers() -> None:
    weights = RewardWeights({"success": np.float32(1.0)}, gamma=np.float32(0.5))
    env = handover_marl.parallel_env(**SYNTHETIC, control_period=np.int64(1), rewards=weights)
    env.reset(seed=np.int64(3))
    assert (env.config.control_steps, type(env.config.control_period)) == (1000, float)
    assert handover_marl.parallel_env(**SYNTHETIC, control_period=np.float32(0.1)).config.control_period == 0.1


@pytest.mark.slow
def test_after_a_failed_reset_there_is_no_episode(own_data: Path) -> None:
    env = make(own_data)
    env.reset(options={"scene_id": 9})
    (own_data / "assets" / "004_sugar_box" / "model_normalized.urdf").write_text("no robot")
    with pytest.raises(SimulationError, match="004_sugar_box"):
        env.reset(options={"scene_id": 14})
    assert env.agents == []
    for call in (lambda: env.step(both(START)), env.state):
        with pytest.raises(ResetNeededError, match="call reset"):
            call()
    env.reset(options={"scene_id": 9})
    assert env.step(both(START))[4]["giver"]["steps"] == 100
    env.close()
    env.close()
    for call in (lambda: env.step(both(START)), env.reset):
        with pytest.raises(ResetNeededError, match="the environment is closed; make another one"):
            call()


@pytest.mark.slow
def test_pictures_without_a_screen(fake_data: Path) -> None:
    env = make(fake_data, render_mode="rgb_array", camera=CameraConfig(width=160, height=120))
    env.reset(options={"scene_id": 9})
    first = env.render()
    assert first.shape == (120, 160, 3)
    assert first.dtype == np.uint8
    assert first.std() > 10
    for _ in range(2):
        env.step(both(START + np.float32(0.5)))
    assert (env.render() != first).mean() > 0.005


#: Number of a scene in which the person picks up the object early, at step 1039.
EARLY = 69


def timed(step: int, release_at: int = 10**9) -> np.ndarray:
    """Return the giver's action at a physics step; it does not depend on the control period."""
    shift = (0.15, -0.1, 0.05) if step >= 1100 else (0.0, 0.0, 0.0)
    return make_giver_action(displacement=shift, rotation=(0.0, 0.0, 2.0 * shift[0]), release=step >= release_at)


def to_the_end(env: HandoverEnv, release_at: int = 10**9) -> list[Any]:
    """Simulate an episode and return the results of the reset and of all steps."""
    observations, infos = env.reset(seed=0, options={"scene_id": EARLY})
    results: list[Any] = [(observations, infos)]
    while env.agents:
        results.append(env.step(both(START, timed(infos["giver"]["steps"], release_at))))
        infos = results[-1][-1]
    env.close()
    return results


@pytest.mark.slow
def test_infos_are_the_same_numbers_all_along() -> None:
    """Infos have the same keys and are numbers from the reset to the end by a drop.

    Many libraries store infos in arrays that they allocate at the start.
    """
    results = to_the_end(parallel_env(**SYNTHETIC, rewards="shaped"), 1300)
    for agent in AGENTS:
        keys = {"scene_id", "status", "steps", "release_step", "release_reason"}
        keys |= {f"reward/{name}" for name in getattr(SHAPED, agent)}
        for *others, infos in results:
            assert infos[agent].keys() == keys
            assert {type(value) for value in infos[agent].values()} <= {int, float}
            if len(others) > 1:
                terms = [value for key, value in infos[agent].items() if key.startswith("reward/")]
                assert type(others[1][agent]) is float
                assert others[1][agent] == pytest.approx(sum(terms))
    first, last = results[0][-1]["giver"], results[-1][-1]["giver"]
    assert (first["status"], first["release_reason"], first["release_step"]) == (EpisodeStatus.RUNNING, -1, -1)
    assert last["status"] & EpisodeStatus.OBJECT_DROP
    assert RELEASE_REASONS[last["release_reason"]] is ReleaseReason.VOLUNTARY
    assert last["release_step"] == 1300
    assert any(info[-1]["giver"]["reward/discomfort"] for info in results)
    assert results[-1][2:4] == ({"giver": True, "receiver": True}, {"giver": False, "receiver": False})
    # What ends in the last cycle is not cut off.
    again = to_the_end(parallel_env(**SYNTHETIC, max_cycles=len(results) - 1), 1300)[-1]
    assert again[2:4] == results[-1][2:4]


def assert_as_seen_by_the_giver(one: dict[str, np.ndarray], other: dict[str, np.ndarray], atol: float) -> None:
    """Check that observations of the giver are equal; the tolerance `atol` holds for simulated values only."""
    for key, value in one.items():
        own = key in ("replay_wrist_poses", "replay_object_poses", "deviation", "holding", "time", "released")
        np.testing.assert_allclose(value, other[key], rtol=0, atol=0.0 if own else atol, err_msg=key)


@pytest.mark.slow
def test_an_episode_that_ends_inside_a_control_step_stops_there() -> None:
    """The giver's last observation and costs refer to the step in which the episode ended."""
    config = WorldConfig(protocol=ProtocolConfig(horizon_steps=1350))
    options = SYNTHETIC | {"world_config": config, "rewards": "shaped"}
    coarse, fine = (to_the_end(parallel_env(**options, control_period=period)) for period in (0.1, 0.05))
    last, same = coarse[-1], fine[-1]
    assert [result[-1]["giver"]["steps"] for result in coarse[-2:]] == [1300, 1350]
    assert same[-1]["giver"]["steps"] == 1350
    assert last[2:4] == same[2:4] == (dict.fromkeys(AGENTS, False), dict.fromkeys(AGENTS, True))
    assert last[-1]["giver"]["status"] == EpisodeStatus.TIMEOUT
    assert_as_seen_by_the_giver(last[0]["giver"], same[0]["giver"], 2e-6)
    before = fine[-2]
    assert before[-1]["giver"]["steps"] == 1300
    way = same[0]["giver"]["deviation"][1:4].astype(float) - before[0]["giver"]["deviation"][1:4]
    assert np.linalg.norm(way) > 0.01, "on its way"
    effort = SHAPED.giver["effort"] * float(way @ way) / 0.05
    assert last[-1]["giver"]["reward/effort"] == pytest.approx(effort, rel=1e-4)
    assert last[-1]["giver"]["reward/waiting"] == pytest.approx(SHAPED.giver["waiting"] * 0.05, rel=1e-5)
    for agent in AGENTS:
        assert last[-1][agent] == pytest.approx(same[-1][agent], abs=1e-6)
