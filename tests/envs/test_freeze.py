from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import handover_marl
from handover_marl.envs.constructors import parallel_env
from handover_marl.envs.wrappers.freeze import FrozenPartnerEnv, freeze
from handover_marl.envs.wrappers.wrapper import SingleAgentEnv
from handover_marl.episode.observations import Observation
from handover_marl.errors import ActionError, OptionError, PolicyError, ResetNeededError, UnknownNameError
from handover_marl.givers import Action, Giver, make_giver_action
from tests.envs.test_handover_env import REPLAY, START
from tests.helpers.equality import assert_equal

SYNTHETIC: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val"}
pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning"),
    pytest.mark.usefixtures("only_known_scenes"),
]


@pytest.fixture
def only_known_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "handover_marl.datasets.official.OfficialDataset.list_scenes", lambda self, setup, split: (9, 14)
    )


def frozen(data: Path, agent: str = "receiver", partner: Any = None, **options: Any) -> FrozenPartnerEnv:
    return freeze(parallel_env(data_dir=data, **options), agent, partner)


@pytest.mark.slow
def test_benchmark_view_equals_the_two_agent_world(fake_data: Path) -> None:
    view = handover_marl.benchmark_env(split="val", data_dir=fake_data)
    world = handover_marl.parallel_env(split="val", data_dir=fake_data)
    assert view.possible_agents == ["receiver"]
    mine, _ = view.reset(seed=1, options={"scene_id": 9})
    theirs, _ = world.reset(seed=1, options={"scene_id": 9})
    for _ in range(5):
        assert_equal(mine["receiver"], theirs["receiver"])
        mine = view.step({"receiver": START})[0]
        theirs = world.step({"receiver": START, "giver": REPLAY})[0]


@pytest.mark.parametrize("agent", ["receiver", "giver"])
def test_the_partners_action_is_not_taken_from_outside(fake_data: Path, agent: str) -> None:
    """An action for the partner is refused, and the episode continues as without this call."""
    env, untouched = (frozen(fake_data, agent, split="val") for _ in range(2))
    own = {"receiver": START, "giver": REPLAY}[agent]
    for one in (env, untouched):
        one.reset(seed=1, options={"scene_id": 9})
    with pytest.raises(ActionError, match=f"a dict with one action, for the {agent}"):
        env.step({agent: own, env.partner_agent: make_giver_action(rate=-1.0)})
    assert_equal(env.step({agent: own}), untouched.step({agent: own}))


def test_infos_fit_into_vector_environments(fake_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    envs = gymnasium.make_vec("HandoverMARL/Receiver-v0", 2, vectorization_mode="sync", data_dir=fake_data)
    envs.reset(seed=[1, 2])
    view = envs.envs[0].unwrapped
    assert isinstance(view, SingleAgentEnv)
    monkeypatch.setattr(view.env.unwrapped._episode._referee, "release_step", 7)
    *_, infos = envs.step(np.stack([START, START]))
    np.testing.assert_array_equal(infos["_release_step"], [True, True])
    np.testing.assert_array_equal(infos["release_step"], [7, -1])
    assert all(value.dtype.kind in "biuf" for value in infos.values())
    envs.close()


@pytest.mark.parametrize(
    ("agent", "partner", "error", "message"),
    [
        ("giver", "replay", OptionError, "must be a receiver, because the giver is controlled, .* agent='receiver'"),
        ("robot", None, UnknownNameError, "agent"),
        ("receiver", dict, OptionError, r"must be a subclass of handover_marl\.givers\.Giver"),
    ],
)
def test_wrong_partners(fake_data: Path, agent: str, partner: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        frozen(fake_data, agent, partner)


def test_order_and_malformed_actions(fake_data: Path) -> None:
    env = frozen(fake_data)
    with pytest.raises(OptionError, match="both agents, got only receiver"):
        freeze(env, "giver")
    with pytest.raises(OptionError, match=r"made by handover_marl\.parallel_env\(\)"):
        freeze(handover_marl.env(data_dir=fake_data), "giver")
    with pytest.raises(ResetNeededError):
        env.step({"receiver": START})
    env.reset(seed=0)
    before = env.state()
    for actions in (None, {}, {"receiver": START[:8]}, {"reciever": START}):
        with pytest.raises(ActionError):
            env.step(actions)  # type: ignore[arg-type]
    np.testing.assert_array_equal(before, env.state())
    env.close()
    with pytest.raises(ResetNeededError):
        env.step({"receiver": START})


class Counting(Giver):
    """Giver that fails after 0.05 s if it is asked to."""

    name = "counting"

    def __init__(self, fails: bool = False) -> None:
        self.fails = fails

    def reset(self, seed: int | None = None) -> None:
        self.count = 0

    def act(self, observation: Observation) -> Action:
        self.count += 1
        if self.fails and observation["time"][0] > 0.05:
            raise ZeroDivisionError("nought")
        return make_giver_action(rate=0.1 * self.count)


def test_failing_partners_are_reported() -> None:
    env = freeze(parallel_env(**SYNTHETIC), "receiver", (Counting, {"fails": True}))
    env.reset(seed=0)
    env.step({"receiver": START})
    with pytest.raises(PolicyError, match=r"policy 'counting' failed \(after 100 steps\): ZeroDivisionError: nought"):
        env.step({"receiver": START})
