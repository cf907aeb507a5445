from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test

import handover_marl
from handover_marl.envs.freeze import FrozenPartnerEnv
from handover_marl.episode.clock import PolicyClock
from handover_marl.errors import UnknownNameError
from tests.envs.test_handover_env import REPLAY, START

pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning"),
    pytest.mark.usefixtures("only_known_scenes"),
]


@pytest.fixture
def only_known_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("handover_marl.datasets.official.OfficialDataset.split", lambda self, setup, split: (9, 14))


def test_benchmark_view_equals_the_two_agent_world(fake_data: Path) -> None:
    view = handover_marl.benchmark_env(split="val", data_dir=fake_data)
    world = handover_marl.parallel_env(split="val", data_dir=fake_data)
    assert view.possible_agents == ["receiver"]
    mine, _ = view.reset(seed=1, options={"scene_id": 9})
    theirs, _ = world.reset(seed=1, options={"scene_id": 9})
    for _ in range(5):
        for key, value in mine["receiver"].items():
            np.testing.assert_array_equal(value, theirs["receiver"][key])
        mine = view.step({"receiver": START})[0]
        theirs = world.step({"receiver": START, "giver": REPLAY})[0]


def test_benchmark_view_cannot_be_talked_out_of_the_protocol(fake_data: Path) -> None:
    for option in ("physics", "partner", "agent"):
        with pytest.raises(TypeError):
            handover_marl.benchmark_env(data_dir=fake_data, **{option: "exact"})


@pytest.mark.parametrize("agent", ["receiver", "giver"])
def test_parallel_api(fake_data: Path, agent: str) -> None:
    parallel_api_test(FrozenPartnerEnv(agent, data_dir=fake_data), num_cycles=20)


@pytest.mark.parametrize("name", ["Receiver", "Giver"])
def test_gymnasium_and_stable_baselines_accept_the_view(fake_data: Path, name: str) -> None:
    env = gymnasium.make(f"HandoverMARL/{name}-v0", setup="s0", data_dir=fake_data, render_mode="rgb_array")
    check_env(env.unwrapped, skip_render_check=True)
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the extra `train`")
    sb3.check_env(env, warn=False)
    env.close()


def test_infos_fit_into_vector_environments(fake_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    envs = gymnasium.make_vec("HandoverMARL/Receiver-v0", 2, vectorization_mode="sync", data_dir=fake_data)
    envs.reset(seed=[1, 2])
    referee = envs.envs[0].unwrapped.view.env._episode._referee
    monkeypatch.setattr(referee, "release_step", 7)
    *_, infos = envs.step(np.stack([START, START]))
    np.testing.assert_array_equal(infos["_release_step"], [True, False])
    assert infos["release_step"][0] == 7
    envs.close()


def test_the_frozen_receiver_moves_the_robot(fake_data: Path) -> None:
    env = FrozenPartnerEnv("giver", "yang2021", data_dir=fake_data)
    observations, _ = env.reset(options={"scene_id": 9})
    start = observations["giver"]["robot_joint_position"]
    for _ in range(3):
        observations, *_ = env.step({"giver": REPLAY})
    assert np.abs(observations["giver"]["robot_joint_position"] - start).max() > 0.01


def test_unknown_partners(fake_data: Path) -> None:
    with pytest.raises(UnknownNameError, match="giver 'nobody'; valid: cooperative, hesitant"):
        FrozenPartnerEnv("receiver", "nobody", data_dir=fake_data)
    with pytest.raises(UnknownNameError, match="receiver 'replay'; valid: hold, learned, omg"):
        FrozenPartnerEnv("giver", "replay", data_dir=fake_data)
    with pytest.raises(UnknownNameError, match="agent"):
        FrozenPartnerEnv("robot", data_dir=fake_data)


class CountingPolicy:
    """Acts with the number of times it was asked; wants to be asked when `hold_time` has passed."""

    def __init__(self, hold_time: float) -> None:
        self.hold_time = hold_time
        self.asked = 0

    def reset(self, seed: int | None) -> None:
        self.asked = 0

    def act(self, observation: dict[str, Any]) -> np.ndarray:
        self.asked += 1
        return np.full(9, self.asked, dtype=np.float32)


@pytest.mark.parametrize(
    ("hold_time", "expected"), [(0.1, [1, 2, 3, 4, 5]), (0.25, [1, 1, 1, 2, 2]), (float("inf"), [1] * 5)]
)
def test_partners_are_asked_when_they_want_to_be(hold_time: float, expected: list[int]) -> None:
    clock = PolicyClock(CountingPolicy(hold_time))
    clock.reset(None)
    times = np.arange(5, dtype=np.float32) * np.float32(0.1)
    assert [int(clock.act({"time": times[n : n + 1]})[0]) for n in range(5)] == expected
