"""Tests of environments in which a fixed partner acts as in evaluations: at its own control period and seeds."""

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.utils import seeding

import handover_marl
from handover_marl import receivers
from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP
from handover_marl.envs.constructors import parallel_env
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrappers.control_agent import FixedPartnerEnv, control_agent
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import derive_giver_seed, run_episode
from handover_marl.episode.observations import Observation
from handover_marl.errors import ActionError, OptionError, PolicyError, ResetNeededError, UnknownNameError
from handover_marl.givers import Action, Giver, make_giver_action
from handover_marl.policies.reference import parse_policy
from tests.envs.test_handover_env import REPLAY, START, SYNTHETIC
from tests.episode.test_loop import ScribblingGiver
from tests.helpers.equality import assert_equal

pytestmark = [pytest.mark.filterwarnings("ignore::UserWarning"), pytest.mark.usefixtures("only_known_scenes")]


@pytest.fixture
def only_known_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "handover_marl.datasets.official.OfficialDataset.list_scenes", lambda self, setup, split: (9, 14)
    )


def frozen(data: Path, agent: str = "receiver", partner: Any = None, **options: Any) -> FixedPartnerEnv:
    return control_agent(parallel_env(data_dir=data, **options), agent, partner)


@pytest.mark.slow
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


@pytest.mark.parametrize(
    ("agent", "partner", "error", "message"),
    [
        ("giver", "replay", UnknownNameError, "unknown receiver 'replay'"),
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
        control_agent(env, "giver")
    with pytest.raises(OptionError, match=r"made by handover_marl\.parallel_env\(\)"):
        control_agent(handover_marl.env(data_dir=fake_data), "giver")
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
    env = control_agent(parallel_env(**SYNTHETIC), "receiver", (Counting, {"fails": True}))
    env.reset(seed=0)
    env.step({"receiver": START})
    with pytest.raises(
        PolicyError, match=r"'counting' \(after 100 steps\) failed: ZeroDivisionError: nought \(.*py, line"
    ):
        env.step({"receiver": START})


AT_REST = {"giver": REPLAY, "receiver": START}
SEED = 7
#: Run seed that an environment with the seed `SEED` draws for its first episode.
RUN_SEED = int(seeding.np_random(SEED)[0].integers(2**32))
#: Physics steps of an episode; within them givers deviate, and receivers approach.
HORIZON = 1000


def make_env(control_period: float = 0.1) -> HandoverEnv:
    """Make an environment with short episodes, in which only the protocol's rules end an episode."""
    config = replace(OFFICIAL_CONFIG, protocol=replace(OFFICIAL_CONFIG.protocol, horizon_steps=HORIZON))
    return handover_marl.parallel_env(world_config=config, control_period=control_period, **SYNTHETIC)


def play_pair(agent: str, partner: Any, scene: int) -> tuple[Any, Observation]:
    """Play an episode of a partner and an agent at rest as in evaluations; return outcome and last observation."""
    base = make_env()
    config = base.config
    policy = parse_policy(agent, partner).make(base.dataset, config.world_config, config.setup)
    episode = Episode(config.physics, config.world_config)
    episode.reset(base.dataset.load_scene(scene))
    pair = (policy, None) if agent == "receiver" else (receivers.make("hold", base.dataset), policy)
    run_episode(episode, *pair, seed=RUN_SEED)
    step = episode.release_step
    end = (int(episode.status), episode.steps, -1 if step is None else step), episode.observe()
    episode.close()
    return end


def play_frozen(agent: str, partner: Any, scene: int, period: float) -> tuple[Any, Observation]:
    """Play this episode in an environment with a fixed partner; the other agent overwrites its observations."""
    (live,) = {"giver", "receiver"} - {agent}
    env = handover_marl.control_agent(make_env(period), live, partner)
    observations, _ = env.reset(seed=SEED, options={"scene_id": scene})
    while env.agents:
        for value in observations[live].values():
            value[...] = 0.0
        observations, _, _, _, infos = env.step({live: AT_REST[live]})
    env.close()
    return tuple(int(infos[live][key]) for key in ("status", "steps", "release_step")), observations[live]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agent", "partner", "scene", "period"),
    # These policies decide more often than the environment, have varying periods, random numbers or a camera.
    [
        ("receiver", "yang2021:wait=0.2", 14, 0.05),
        ("receiver", "random", 19, 0.1),
        ("receiver", "gaddpg:wait=0.7", 9, 0.1),
        ("giver", "tired", 14, 0.01),
        ("giver", "replay", 19, 0.05),
        ("giver", "noisy", 19, 0.05),
        ("giver", ScribblingGiver, 69, 0.1),
    ],
)
def test_partners_act_as_in_pair(agent: str, partner: Any, scene: int, period: float) -> None:
    if str(partner).startswith("gaddpg"):
        pytest.importorskip("embreex", reason="needs the extra `vision`")
    outcome, observation = play_pair(agent, partner, scene)
    own_outcome, own_observation = play_frozen(agent, partner, scene, period)
    assert own_outcome == outcome
    for key in ("gripper_pose", "object_poses", "hand_keypoints"):
        np.testing.assert_array_equal(own_observation[key], observation[key], err_msg=key)


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
    """Return the decisions of `Irregular` in the first episode of an environment, by its seed in `evaluate-pair`."""
    giver_seed = derive_giver_seed(int(seeding.np_random(seed)[0].integers(2**32)), scene)
    rng, asked = np.random.default_rng(giver_seed), [0]
    while asked[-1] < steps:
        asked.append(asked[-1] + draw_hold_steps(rng))
    return {giver_seed: asked[:-1]}


def test_partners_in_vector_environments_keep_their_own_periods() -> None:
    Irregular.decisions.clear()
    options: dict[str, Any] = {"dataset": "synthetic", "split": "val", "scenes": [9], "control_period": 0.1}
    envs = handover_marl.vector_env(3, "receiver", Irregular, **options)
    envs.reset(seed=SEED)
    observations, *_, infos = envs.step(np.tile(START, (3, 1)))
    np.testing.assert_array_equal(infos["steps"], 100)
    np.testing.assert_allclose(observations["time"][:, 0], 0.1, rtol=1e-6)
    envs.close()
    expected = [list_decisions(SEED + number, 9, 100) for number in range(3)]
    assert Irregular.decisions == {**expected[0], **expected[1], **expected[2]}
    assert len({len(asked) for asked in Irregular.decisions.values()}) > 1, "their decisions are at different times"
