"""Tests that a frozen partner acts as in `pair`: at its own control period, and with the same seeds."""

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest
from gymnasium.utils import seeding
from pettingzoo.utils.conversions import parallel_to_aec

import handover_marl
from handover_marl import givers, receivers
from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrappers.wrapper import SingleAgentEnv
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import derive_giver_seed, run_episode
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import to_numpy
from handover_marl.givers import Action, Giver, make_giver_action
from handover_marl.policies.reference import parse_policy
from tests.envs.test_handover_env import REPLAY, START

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

AT_REST = {"giver": REPLAY, "receiver": START}
SEED = 7
#: Run seed that an environment with the seed `SEED` draws for its first episode.
RUN_SEED = int(seeding.np_random(SEED)[0].integers(2**32))
#: Scenes of `s0 val`, and control periods of the environment (s).
SCENES, PERIODS = (9, 14, 19), (0.1, 0.05, 0.01)
#: Policies that need a file, only choose one of the others, or have the class of another one.
LEFT_OUT = ("gaddpg", "learned", "omg_hand_aware", "omg_unchecked_last", "population")
#: Policies that decide much more often than an environment, in several scenes; the others are played in one scene.
OFTEN = ("yang2021", "tired")
#: Physics steps; within them the givers deviate, and most of the receivers hand over.
HORIZONS = {"receiver": 5000, "giver": 2500}


class End(NamedTuple):
    """End of an episode."""

    outcome: tuple[int, int, int]
    state: Observation


def make_env(partner_agent: str, **options: Any) -> HandoverEnv:
    """Make an environment with short episodes, in which only the protocol's rules end an episode."""
    protocol = replace(OFFICIAL_CONFIG.protocol, horizon_steps=HORIZONS[partner_agent])
    defaults = {"dataset": "synthetic", "split": "val", "physics": "fast"}
    return handover_marl.parallel_env(
        world_config=replace(OFFICIAL_CONFIG, protocol=protocol), **{**defaults, **options}
    )


def play_pair(agent: str, partner: str, scene: int, **options: Any) -> End:
    """Play an episode of a partner and an agent at rest as `pair` does."""
    base = make_env(agent, **options)
    config = base.config
    policy = parse_policy(agent, partner).make(base.dataset, config.world_config, config.setup)
    episode = Episode(config.physics, config.world_config)
    episode.reset(base.dataset.load_scene(scene))
    pair = (policy, None) if agent == "receiver" else (receivers.make("hold", base.dataset), policy)
    run_episode(episode, *pair, seed=RUN_SEED)
    step = episode.release_step
    end = End((int(episode.status), episode.steps, -1 if step is None else step), episode.observe())
    episode.close()
    return end


def play_frozen(agent: str, partner: str, scene: int, period: float, **options: Any) -> End:
    """Play this episode in an environment in which the partner is frozen and the other agent is at rest."""
    base = make_env(agent, control_period=period, **options)
    (live,) = {"giver", "receiver"} - {agent}
    env = handover_marl.freeze(base, live, partner)
    env.reset(seed=SEED, options={"scene_id": scene})
    while env.agents:
        observations, _, _, _, infos = env.step({live: AT_REST[live]})
    env.close()
    return read_end(infos[live], observations[live])


def read_end(info: Any, observation: Observation) -> End:
    """Return the end of an episode that an agent has observed."""
    outcome = tuple(int(info[key]) for key in ("status", "steps", "release_step"))
    return End(outcome, observation)  # type: ignore[arg-type]


def assert_equal_ends(found: End, expected: End, tolerance: float) -> None:
    """Check that outcomes are equal, and states up to a tolerance (m, rad)."""
    assert found.outcome == expected.outcome
    for key in ("gripper_pose", "object_poses", "hand_keypoints"):
        np.testing.assert_allclose(found.state[key], expected.state[key], rtol=0, atol=tolerance, err_msg=key)


def list_cases(names: tuple[str, ...]) -> list[tuple[str, int, float]]:
    """List policies, scenes and control periods: all three for some policies, one for each of the others."""
    cases = []
    for number, name in enumerate(name for name in names if name not in LEFT_OUT):
        every = list(zip([name] * 3, SCENES, PERIODS, strict=True))
        cases += every if name in OFTEN else [every[number % 3]]
    return cases


@pytest.mark.slow
@pytest.mark.parametrize(("partner", "scene", "period"), list_cases(receivers.list_available()))
def test_receivers_act_as_in_pair(partner: str, scene: int, period: float) -> None:
    if partner.startswith("omg"):
        pytest.importorskip("igl", reason="needs the extra `planning`")
    expected = play_pair("receiver", partner, scene)
    assert_equal_ends(play_frozen("receiver", partner, scene, period), expected, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(("partner", "scene", "period"), list_cases(givers.list_available()))
def test_givers_act_as_in_pair(partner: str, scene: int, period: float) -> None:
    expected = play_pair("giver", partner, scene)
    assert_equal_ends(play_frozen("giver", partner, scene, period), expected, 0.0)


@pytest.mark.slow
def test_a_recorded_scene_ends_as_in_pair(real_data: Path) -> None:
    options: dict[str, Any] = {"dataset": "dexycb", "data_dir": real_data, "physics": "fast"}
    end = play_frozen("receiver", "reactive", 19, 0.05, **options)
    assert end.outcome[1:] == (3362, 2761)


@pytest.mark.parametrize(("agent", "partner", "scene"), [("receiver", "yang2021", 14), ("giver", "tired", 19)])
def test_partners_in_vector_environments_act_as_in_pair(agent: str, partner: str, scene: int) -> None:
    pytest.importorskip("mujoco", reason="needs the extra `mujoco`")
    (live,) = {"giver", "receiver"} - {agent}
    expected = play_pair(agent, partner, scene, physics="mujoco")
    options = {**vars(make_env(agent, physics="mujoco", scenes=[scene]).config), "control_period": 0.1}
    envs = handover_marl.vector_env(1, live, partner, autoreset="disabled", **options)
    envs.reset(seed=SEED)
    ended = np.zeros(1, dtype=bool)
    while not ended.all():
        observations, _, terminated, truncated, infos = envs.step(AT_REST[live][None])
        ended = terminated | truncated
    envs.close()
    own, info = ({key: values[0] for key, values in found.items()} for found in (observations, infos))
    assert_equal_ends(read_end(info, own), expected, 1e-4)


class Irregular(Giver):
    """Giver whose time to the next decision is drawn at each decision.

    Attributes:
        decisions: Physics steps of the decisions in the last episode with each seed.
    """

    name = "irregular"
    decisions: ClassVar[dict[int | None, list[int]]] = {}

    def reset(self, seed: int | None = None) -> None:
        self.rng, self.hold, self.own = np.random.default_rng(seed), 0.0, list[int]()
        self.decisions[seed] = self.own

    @property
    def hold_time(self) -> float:
        return self.hold

    def act(self, observation: Observation) -> Action:
        self.own.append(round(float(observation["time"][0]) / TIME_STEP))
        self.hold = draw_hold_steps(self.rng) * TIME_STEP
        return make_giver_action(rate=-0.5)


def draw_hold_steps(rng: np.random.Generator) -> int:
    return int(rng.choice([13, 40, 270]))


def list_decisions(seed: int, scene: int, steps: int) -> dict[int | None, list[int]]:
    """Return the decisions of `Irregular` in the first episode of an environment, by its seed in `pair`."""
    giver_seed = derive_giver_seed(int(seeding.np_random(seed)[0].integers(2**32)), scene)
    rng, asked = np.random.default_rng(giver_seed), [0]
    while asked[-1] < steps:
        asked.append(asked[-1] + draw_hold_steps(rng))
    return {giver_seed: asked[:-1]}


@pytest.mark.parametrize("api", ["parallel", "aec", "gymnasium"])
def test_partners_keep_their_own_period(api: str) -> None:
    env: Any = handover_marl.freeze(make_env("giver"), "receiver", Irregular)
    Irregular.decisions.clear()
    if api == "aec":
        env = parallel_to_aec(env)
    elif api == "gymnasium":
        env = SingleAgentEnv(env)
    env.reset(seed=SEED, options={"scene_id": 9})
    for _ in range(4):
        env.step(START if api in ("aec", "gymnasium") else {"receiver": START})
    assert Irregular.decisions == list_decisions(SEED, 9, 400)
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["threads", "warp"])
def test_partners_in_vector_environments_keep_their_own_periods(backend: str) -> None:
    pytest.importorskip("mujoco_warp" if backend == "warp" else "mujoco", reason="needs an extra")
    Irregular.decisions.clear()
    options: dict[str, Any] = {"dataset": "synthetic", "split": "val", "scenes": [9], "control_period": 0.1}
    envs = handover_marl.vector_env(3, "receiver", Irregular, backend=backend, **options)
    envs.reset(seed=SEED)
    observations, *_, infos = envs.step(np.tile(START, (3, 1)))
    np.testing.assert_array_equal(to_numpy(infos["steps"]), 100)
    np.testing.assert_allclose(to_numpy(observations["time"])[:, 0], 0.1, rtol=1e-6)
    envs.close()
    expected = [list_decisions(SEED + number, 9, 100) for number in range(3)]
    assert Irregular.decisions == {**expected[0], **expected[1], **expected[2]}
    assert len({len(asked) for asked in Irregular.decisions.values()}) > 1, "their decisions are at different times"
