"""Tests of vector environments: each environment behaves like a single one, whatever their number."""

import copy
import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest

import handover_marl
from handover_marl.config import WorldConfig
from handover_marl.envs.vector.batched_envs import EncodedEpisodeBatch
from handover_marl.envs.vector.env_groups import SequentialEnvGroup
from handover_marl.envs.vector.vector_env import HandoverVectorEnv
from handover_marl.envs.wrappers.control_agent import control_agent
from handover_marl.envs.wrappers.wrapper import SingleAgentEnv
from handover_marl.episode.episode import Episode
from handover_marl.errors import (
    ActionError,
    OptionError,
    PolicyError,
    ResetNeededError,
    SimulationError,
    UnknownNameError,
    WorkerError,
)
from handover_marl.receivers import Receiver
from tests.helpers.equality import assert_equal
from tests.learning.custom import move_first_joint, offset_to_object

#: The objects are boxes, cylinders and balls, so that models of several layouts are simulated together.
OPTIONS: dict[str, Any] = {"setup": "s0", "split": "train", "dataset": "synthetic", "physics": "mujoco"}
COUNT = 3
#: Options of short episodes, so that all of them end and new ones start.
SHORT: dict[str, Any] = {**OPTIONS, "max_cycles": 13, "control_period": 0.13}
MORE_THAN_AN_EPISODE = 16


class Failing(Receiver):
    """Receiver that raises a KeyError in its third decision."""

    name, control_period = "failing", 0.13

    def reset(self, seed: int | None = None) -> None:
        self.decisions = 0

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        self.decisions += 1
        if self.decisions == 3:
            raise KeyError("nonsense")
        return observation["robot_joint_position"]


def single(agent: str, partner: str, **options: Any) -> gymnasium.Env[Any, Any]:
    world = handover_marl.parallel_env(**options)
    return control_agent(world, agent, partner, api="gymnasium")


def rollout(envs: gymnasium.vector.VectorEnv[Any, Any, Any], steps: int, seed: int = 3) -> list[Any]:
    """Return the results of `reset` and of all steps with random actions, and close the environments.

    The first environment starts anew after eight steps, so that its episodes end later than those of the others.
    """
    rng, said = np.random.default_rng(0), list(envs.reset(seed=seed))
    space = envs.single_action_space
    for step in range(steps):
        if step == 8:
            envs.reset(options={"reset_mask": np.arange(envs.num_envs) == 0})
        draw = rng.normal(size=(envs.num_envs, *space.shape))
        seen = said[0] if len(said) == 2 else said[-5]
        near = 0.0 if not isinstance(seen, dict) or space.shape != (9,) else seen["robot_joint_position"]
        said += envs.step((near + 0.15 * draw).astype(np.float32))
    envs.close()
    return said


@pytest.mark.slow
def test_features_may_leave_observations_as_they_are() -> None:
    plain, encoded = (
        handover_marl.vector_env(2, "receiver", "replay", threads=1, **OPTIONS, **encoding)
        for encoding in ({}, {"features": "observation", "action_scheme": "cartesian_delta"})
    )
    assert encoded.single_observation_space == plain.single_observation_space
    assert encoded.single_action_space.shape == (7,)
    assert_equal(encoded.reset(seed=0), plain.reset(seed=0))
    still = np.repeat(np.array([[0, 0, 0, 0, 0, 0, -1]], np.float32), 2, axis=0)
    assert_equal(
        encoded.step(still)[0]["object_poses"],
        plain.step(plain.reset(seed=0)[0]["robot_joint_position"])[0]["object_poses"],
    )
    for envs in (plain, encoded):
        envs.close()


WAITING = {**OPTIONS, "control_period": 0.2, "max_cycles": 25}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agent", "partner", "encodings", "autoreset", "steps", "options"),
    [
        ("receiver", "noisy", (), "next_step", MORE_THAN_AN_EPISODE, SHORT),
        ("giver", "yang2021:wait=0.2", (), "same_step", MORE_THAN_AN_EPISODE, SHORT),
        ("receiver", "cooperative", ("close", "grasp_servo"), "next_step", 12, WAITING),
        ("receiver", "replay", (offset_to_object, move_first_joint), "next_step", 12, {**WAITING, "max_cycles": 6}),
        ("receiver", "replay", (), "next_step", 3, {**SHORT, "obs_mode": "state+pointcloud"}),
        ("receiver", "replay", (), "next_step", 3, {**SHORT, "physics": "exact"}),
    ],
    ids=["same", "giver", "waiting", "own", "camera", "exact"],
)
def test_equal_to_single_environments_to_the_bit(
    agent: str, partner: str, encodings: Any, autoreset: str, steps: int, options: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("handover_marl.learning.encodings.schemes.GraspServoScheme.wait", 0.8)

    def make() -> Any:
        live = control_agent(handover_marl.parallel_env(**options), agent, partner)
        return handover_marl.encode(live, *encodings, api="gymnasium") if encodings else SingleAgentEnv(live)

    mode = gymnasium.vector.AutoresetMode[autoreset.upper()]
    expected = rollout(gymnasium.vector.SyncVectorEnv([make] * COUNT, autoreset_mode=mode), steps)
    chosen = dict(zip(("features", "action_scheme"), encodings, strict=False))
    chosen["processes" if agent == "giver" else "threads"] = 2
    together = handover_marl.vector_env(COUNT, agent, partner, autoreset=autoreset, **chosen, **options)
    assert_equal(rollout(together, steps), expected)
    if steps == MORE_THAN_AN_EPISODE:
        assert any(step.any() for step in expected[4::5] + expected[5::5]), "episodes have ended"


@pytest.mark.parametrize("autoreset", ["next_step", "same_step", "disabled"])
def test_the_interface_is_gymnasiums(autoreset: str) -> None:
    envs = handover_marl.vector_env(2, autoreset=autoreset, threads=1, **SHORT)
    mode = gymnasium.vector.AutoresetMode[autoreset.upper()]
    alone = gymnasium.vector.SyncVectorEnv([lambda: single("receiver", "replay", **SHORT)] * 2, autoreset_mode=mode)
    base = gymnasium.vector.VectorEnv
    for name in (*vars(base), *base.__annotations__):
        assert hasattr(envs, name), name
    spaces = ("single_observation_space", "single_action_space", "observation_space", "action_space")
    for name in (*spaces, "num_envs", "render_mode", "closed", "autoreset_mode"):
        assert getattr(envs, name) == getattr(alone, name), name
    assert envs.metadata["autoreset_mode"] is envs.autoreset_mode is mode
    assert envs.spec is None
    if autoreset != "disabled":
        counted = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
        observations, _ = counted.reset(seed=0)
        for _ in range(SHORT["max_cycles"]):
            *_, infos = counted.step(observations["robot_joint_position"])
        np.testing.assert_array_equal(infos["episode"]["l"], SHORT["max_cycles"])
    envs.close()
    alone.close()


@pytest.mark.slow
def test_whole_handovers_to_yang_are_equal_to_the_bit() -> None:
    """Steps of the giver that last a whole episode equal those of single environments."""
    options = {**OPTIONS, "control_period": 0.2, "max_cycles": 28, "rewards": "shaped"}
    encodings = {"features": "giver", "action_scheme": "offer"}
    together = handover_marl.vector_env(2, "giver", "yang2021:wait=0.5", threads=1, **encodings, **options)
    live = [control_agent(handover_marl.parallel_env(**options), "giver", "yang2021:wait=0.5") for _ in range(2)]
    alone = gymnasium.vector.SyncVectorEnv(
        [lambda env=env: handover_marl.encode(env, "giver", "offer", api="gymnasium") for env in live]
    )
    found, expected = (envs.reset(seed=5) for envs in (together, alone))
    assert_equal(list(found), list(expected))
    outputs = np.random.default_rng(0).uniform(-0.3, 0.3, (2, 7)).astype(np.float32)
    steps = [envs.step(outputs) for envs in (together, alone)]
    assert_equal(list(steps[0]), list(steps[1]))
    together.close()
    assert steps[0][1].max() > 0.8, "an object was handed over"


@pytest.mark.slow
def test_the_next_episode_is_the_one_that_a_single_environment_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Resets with a seed, a scene, a mask or no argument start the same episodes as in single environments.

    This also holds if the next episodes are simulated in advance.
    """
    options = {**OPTIONS, "control_period": 0.2, "max_cycles": 6, "rewards": "shaped"}
    options["world_config"] = WorldConfig(initial_joint_noise=0.1)
    monkeypatch.setattr("handover_marl.learning.encodings.schemes.GraspServoScheme.wait", 0.8)
    together = handover_marl.vector_env(
        2, "receiver", "hesitant", features="close", action_scheme="grasp_servo", threads=1, **options
    )
    live = [control_agent(handover_marl.parallel_env(**options), "receiver", "hesitant") for _ in range(2)]
    alone = gymnasium.vector.SyncVectorEnv(
        [lambda env=env: handover_marl.encode(env, "close", "grasp_servo", api="gymnasium") for env in live]
    )
    rng, mask = np.random.default_rng(0), np.array([True, False])
    scene = together.scene_ids[4]
    resets: list[dict[str, Any]] = [
        {"seed": 5},
        {},
        {"options": {"scene_id": scene}},
        {"options": {"reset_mask": mask}},
        {"seed": [1, None], "options": {"reset_mask": mask}},
    ]
    for arguments in resets:
        found, expected = (envs.reset(**copy.deepcopy(arguments)) for envs in (together, alone))
        assert_equal(list(found), list(expected))
        for _ in range(3):
            actions = rng.uniform(-1.0, 1.0, (2, 7)).astype(np.float32)
            assert_equal(list(together.step(actions)), list(alone.step(actions)))
    together.close()


@pytest.mark.slow
def test_cameras_have_the_seeds_of_single_environments(monkeypatch: pytest.MonkeyPatch) -> None:
    """A next episode that was started in advance and is not used takes no seed of the camera."""
    found, expected = [], []
    start, seed_camera = EncodedEpisodeBatch.start, Episode.seed_camera
    monkeypatch.setattr(EncodedEpisodeBatch, "start", lambda *values: (found.append(values[-1]), start(*values)))
    monkeypatch.setattr(Episode, "seed_camera", lambda self, seed: (expected.append(seed), seed_camera(self, seed)))
    options = {**OPTIONS, "control_period": 0.2}
    together = handover_marl.vector_env(
        1, "receiver", features="close", action_scheme="grasp_servo", threads=1, **options
    )
    alone = handover_marl.parallel_env(**options)
    chosen = {"scene_id": together.scene_ids[4]}
    together.reset(seed=5)
    together.step(np.zeros((1, 7), np.float32))
    together.reset(options=chosen)
    together.close()
    alone.reset(seed=5)
    alone.reset(options=chosen)
    assert len(found) == 3
    assert [found[0], found[2]] == expected
    assert len(set(expected)) == 2


@pytest.fixture
def both() -> Iterator[Callable[..., Any]]:
    made = []

    def make(**options: Any) -> Any:
        made.append(handover_marl.vector_env(COUNT, None, threads=2, **{**SHORT, **options}))
        return made[-1]

    yield make
    for envs in made:
        envs.close()


@pytest.mark.slow
@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_both_agents_in_a_batch(both: Callable[..., Any], autoreset: str) -> None:
    batch = both(autoreset=autoreset)
    alone = [handover_marl.parallel_env(**SHORT) for _ in range(COUNT)]
    rng = np.random.default_rng(1)
    seen, _ = batch.reset(seed=11)
    first = [env.reset(11 + number)[0] for number, env in enumerate(alone)]
    ended = np.zeros(COUNT, dtype=bool)
    ends = 0
    for _ in range(MORE_THAN_AN_EPISODE):
        for agent in batch.possible_agents:
            assert batch.observation_space(agent).contains(seen[agent])
            for number, one in enumerate(first):
                assert_equal({key: value[number] for key, value in seen[agent].items()}, one[agent])
        still = seen["receiver"]["robot_joint_position"]
        actions = {
            "receiver": (still + 0.1 * rng.normal(size=still.shape)).astype(np.float32),
            "giver": (0.1 * rng.normal(size=(COUNT, 8))).astype(np.float32),
        }
        seen, rewards, terminations, truncations, infos = batch.step(actions)
        for number, env in enumerate(alone):
            if ended[number] and autoreset == "next_step":
                first[number], ended[number] = env.reset()[0], False
                assert rewards["giver"][number] == 0.0
                continue
            first[number], reward, over, cut, info = env.step(
                {agent: given[number] for agent, given in actions.items()}
            )
            ended[number] = over["giver"] or cut["giver"]
            ends += int(ended[number])
            for agent in env.possible_agents:
                assert rewards[agent][number] == reward[agent]
                assert (terminations[agent][number], truncations[agent][number]) == (over[agent], cut[agent])
            if ended[number] and autoreset == "same_step":
                assert infos["giver"]["_final_obs"][number]
                assert_equal(infos["giver"]["final_obs"][number], first[number]["giver"])
                assert {key: infos["giver"]["final_info"][key][number] for key in info["giver"]} == info["giver"]
                first[number] = env.reset()[0]
            else:
                assert infos["giver"]["steps"][number] == info["giver"]["steps"]
    assert ends == COUNT


@pytest.mark.slow
def test_the_answer_to_an_interrupted_call_is_dropped() -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    def step_until_interrupted() -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        while True:
            envs.step(actions)
            envs.reset()

    envs = handover_marl.vector_env(2, "receiver", "replay", processes=1, **SHORT)
    actions = envs.reset(seed=0)[0]["robot_joint_position"]
    before = signal.signal(signal.SIGALRM, interrupt)
    with pytest.raises(KeyboardInterrupt):
        step_until_interrupted()
    signal.signal(signal.SIGALRM, before)
    observations, infos = envs.reset(seed=5)
    assert infos["steps"].tolist() == [0, 0]
    assert envs.step(observations["robot_joint_position"])[4]["steps"].min() > 0
    envs.close()


@pytest.mark.slow
@pytest.mark.parametrize("workers", [{"threads": 2}, {"processes": 2}], ids=str)
def test_errors_are_raised_and_resets_work(workers: dict[str, int]) -> None:
    envs = handover_marl.vector_env(3, "giver", Failing, **workers, **SHORT)
    with pytest.raises(ResetNeededError, match="first reset must be of all"):
        envs.reset(options={"reset_mask": np.array([True, False, True])})
    envs.reset(seed=0)
    still = np.zeros((3, 8), np.float32)
    with pytest.raises(ActionError, match="not finite"):
        envs.step(np.full((3, 8), np.nan, np.float32))
    envs.step(still)
    envs.step(still)
    with pytest.raises(PolicyError, match="nonsense"):
        envs.step(still)
    with pytest.raises(ResetNeededError):
        envs.step(still)
    envs.reset(seed=0)
    if "threads" in workers:
        envs.step(still)
        envs.close()
        return
    (first, _) = multiprocessing.active_children()
    first.terminate()
    first.join()
    with pytest.raises(WorkerError, match=r"process \d+ of the environments died"):
        envs.step(still)
    envs.close()
    envs.close()
    assert not multiprocessing.active_children()


def test_what_cannot_be_is_refused(both: Callable[..., Any]) -> None:
    for options, error, message in (
        ({"num_envs": 0}, OptionError, "num_envs"),
        ({"num_envs": 2, "processes": 0}, OptionError, "processes"),
        ({"num_envs": 2, "threads": 2, "processes": 2}, OptionError, "pass either threads or processes"),
        ({"num_envs": 2, "agent": None, "partner": "replay"}, OptionError, "partner"),
        ({"num_envs": 2, "agent": "robot"}, UnknownNameError, "agent"),
        ({"num_envs": 2, "autoreset": "always"}, UnknownNameError, "autoreset"),
        ({"num_envs": 10**9}, OptionError, "num_envs must be at most 65536, got 1000000000"),
        ({"num_envs": 2, "features": len}, OptionError, "features 'len' must declare the number of features"),
    ):
        with pytest.raises(error, match=message):
            handover_marl.vector_env(**{**OPTIONS, **options})
    batch = both(obs_mode="state+state")
    assert not isinstance(batch._envs, SequentialEnvGroup), "a mode without cameras"
    with pytest.raises(ResetNeededError):
        batch.step({})
    batch.reset(seed=0)
    with pytest.raises(ActionError, match="dict of arrays"):
        batch.step({"giver": np.zeros((COUNT, 8))})
    with pytest.raises(ActionError, match=r"\(3, 9\)"):
        batch.step({"giver": np.zeros((COUNT, 8)), "receiver": np.zeros((COUNT, 8))})
    with pytest.raises(OptionError, match="seeds"):
        batch.reset(seed=[1])


@pytest.fixture(scope="module")
def three() -> Iterator[HandoverVectorEnv]:
    envs = handover_marl.vector_env(3, "receiver", "replay", threads=1, **OPTIONS)
    yield envs
    envs.close()


STILL = np.tile(np.array([0.0, -1.285, 0, -2.356, 0, 1.571, 0.785, 0.04, 0.04], np.float32), (3, 1))


@pytest.mark.parametrize(
    "arguments",
    [
        {"seed": [1, 2]},
        {"seed": [1, -2, 3]},
        {"options": {"reset_mask": [True, False]}},
        {"options": {"reset_mask": [False, False, False]}},
    ],
    ids=str,
)
def test_malformed_resets_change_nothing(three: HandoverVectorEnv, arguments: dict[str, Any]) -> None:
    three.reset(seed=1)
    with pytest.raises(OptionError, match=r"seed|reset_mask"):
        three.reset(**arguments)
    # Callers own the dictionary that they get; TorchRL replaces its arrays by tensors.
    three.step(STILL)[0].clear()
    after, *_ = three.step(STILL)
    np.testing.assert_allclose(after["time"], 0.2, atol=1e-6)
    after["time"] *= 100.0
    masked, _ = three.reset(options={"reset_mask": np.array([True, False, False])})
    np.testing.assert_allclose(masked["time"][1:], 0.2, atol=1e-6)


def test_vector_environments_cannot_be_copied(three: HandoverVectorEnv) -> None:
    with pytest.raises(OptionError, match="make another one"):
        pickle.dumps(three)


def test_two_threads_at_once_are_refused(three: HandoverVectorEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    three.reset(seed=1)
    envs = three._envs._envs
    simulate = envs.step

    def step_twice(rows: Any, actions: Any) -> Any:
        for call in (lambda: three.step(STILL), lambda: three.reset(seed=1)):
            with pytest.raises(SimulationError, match="another thread is using the vector environment"):
                call()
        return simulate(rows, actions)

    monkeypatch.setattr(envs, "step", step_twice)
    after, *_ = three.step(STILL)
    np.testing.assert_allclose(after["time"], 0.1, atol=1e-6)


@pytest.mark.filterwarnings("ignore:This process")
def test_an_environment_of_the_parent_process_is_refused_after_a_fork(three: HandoverVectorEnv) -> None:
    three.reset(seed=0)
    process = os.fork()
    if process == 0:
        try:
            three.step(STILL)
        except ResetNeededError:
            os._exit(7)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 7
