"""Errors keep their messages, and name what a user can do."""

import pickle
from collections.abc import Callable
from operator import itemgetter
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import handover_marl
from handover_marl import evaluate_pair, givers, receivers
from handover_marl.datasets.custom.scene_file import CustomObject
from handover_marl.datasets.generated.config import GeneratedConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.envs.config import EnvConfig
from handover_marl.episode.loop import call_policy
from handover_marl.episode.spaces import check_receiver_action
from handover_marl.errors import (
    ActionError,
    DataNotFoundError,
    HandoverError,
    OptionError,
    PolicyError,
    ResetNeededError,
    SceneError,
    UnknownArgumentError,
    UnknownNameError,
    check_name,
)
from tests.docs.pages import REPOSITORY


@pytest.mark.parametrize("name", [None, 5, ["s0"], {"s0"}, b"s0", np.array(["s0"]), np.zeros(2), "", "s", object()])
def test_other_values_than_the_names_do_not_exist(name: Any) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown setup .*; valid: s0, s1"):
        check_name("setup", name, ("s0", "s1"))


def test_errors_keep_their_message_in_other_processes() -> None:
    for error in (
        UnknownArgumentError("benchmark", "scene", ("scenes", "setup")),
        UnknownNameError("split", "tests", ("train", "val", "test"), "see the documentation"),
    ):
        assert str(pickle.loads(pickle.dumps(error))) == str(error)
        assert "; did you mean " in str(error)


GYM_ID = "HandoverMARL/Receiver-v0"


def open_dataset(name: str) -> None:
    handover_marl.parallel_env(dataset=name, split="test")


def make_env(**options: Any) -> handover_marl.HandoverEnv:
    return handover_marl.parallel_env(dataset="synthetic", physics="fast", **options)


def step(actions: dict[str, Any]) -> None:
    env = make_env()
    env.reset(seed=0)
    env.step(actions)


def make_slow(period: float) -> type[receivers.Receiver]:
    """Return a receiver whose control period is a number of milliseconds."""
    kind: Any = type("Slow", (receivers.make("hold").__class__,), {"control_period": period})
    return kind


def act_alone(observation: Any, is_reset: bool) -> None:
    policy = receivers.make("yang2021", SyntheticDataset())
    if is_reset:
        policy.reset(0)
    policy.act(observation)


def load_stored_report() -> handover_marl.Report:
    return handover_marl.load_report(REPOSITORY / "docs/results/data/episodes/omg-dexycb-s3-3.0.json")


def look_up(key: str) -> None:
    policy: Any = SimpleNamespace(name="mine", act=itemgetter(key), hold_time=0.1)
    call_policy(policy, {"time": np.zeros(1)}, 5)


@pytest.mark.parametrize(
    ("function", "argument", "error", "message"),
    [
        (open_dataset, "generated:n=4", SceneError, "random test has no scenes; choose another split"),
        (open_dataset, f"generated:n={10**400}", OptionError, "n of GeneratedConfig must be an integer from 1 to"),
        (lambda n: GeneratedConfig(n=n), 1.5, OptionError, "n of GeneratedConfig must be an integer"),
        (open_dataset, f"own:{'a' * 5000}", OptionError, "more than 255 bytes"),
        (lambda period: handover_marl.parallel_env(control_period=period), 1 / 30, OptionError, "take 0.033"),
        (lambda period: handover_marl.parallel_env(control_period=period), 100, OptionError, "for 100 ms pass 0.1"),
        (lambda name: gymnasium.make(GYM_ID, physic=name), "fast", UnknownArgumentError, "did you mean 'physics'"),
        (lambda actions: handover_marl.encode(make_env()).step(actions), {}, ResetNeededError, r"call reset\(\)"),
        (lambda kind: evaluate_pair(kind, "hold"), receivers.Receiver, OptionError, "got a receiver; "),
        (lambda kind: evaluate_pair("replay", kind), len, OptionError, "or wrap a function or module by as_receiver"),
        (lambda columns: load_stored_report().format(columns=columns), "success", OptionError, r"pass \['success'\]"),
        (lambda time: handover_marl.EvaluationConfig(inference_time=time), 100, OptionError, "for 100 ms pass 0.1"),
        (lambda scene: make_env().dataset.load_scene(scene), "14", SceneError, "by its number, got '14'"),
        (lambda scene: make_env().reset(options={"scene_id": scene}), "105", SceneError, "by its number, got '105'"),
        (lambda fov: handover_marl.make_camera("wrist", vertical_fov=fov), 1.57, OptionError, "number from 5 to 175"),
        (lambda x: handover_marl.CameraConfig(position=(x, 0, 0)), 1600, OptionError, "from -100 to 100, got 1600"),
        (lambda turn: givers.make_giver_action(rotation=(0, 0, turn)), 45, ActionError, "rotation in rad"),
        (lambda rate: givers.make_giver_action(rate=rate), np.nan, ActionError, "rate must be 1 numbers"),
        (lambda period: evaluate_pair("replay", make_slow(period)), 50, OptionError, "for 100 ms set 0.1"),
        (lambda reset: act_alone({"receiver": {}}, reset), True, OptionError, r"pass observations\['receiver'\]"),
        (lambda reset: act_alone({}, reset), False, ResetNeededError, "call reset"),
        (lambda mass: CustomObject("box", 22, mass, 0.5), "heavy", OptionError, "object box must be a finite number"),
        (lambda number: CustomObject("box", number, 0.1, 0.5), "22", OptionError, "from 22 to 16777215, got .22"),
        (lambda name: handover_marl.benchmark(receiver=name), "cooperative", UnknownNameError, "is a giver"),
        (lambda name: evaluate_pair(name, "hold"), "reactive", UnknownNameError, "is a receiver"),
        (lambda mode: EnvConfig(physics="mujoco", render_mode=mode), "human", OptionError, "must be 'rgb_array' with"),
        (lambda file: receivers.make(file, "synthetic"), "runs/a.npz", UnknownNameError, "write learned:runs/a.npz"),
        (givers.make, "wary.py", UnknownNameError, "a class in this file is wary:CLASS"),
        (givers.make, "learned:nope.npz", DataNotFoundError, "export_policy or a training script"),
        (lambda data: receivers.make("yang2021", data), "synthetic", OptionError, r"dataset must be env\.dataset"),
        (lambda mode: make_env(obs_mode=mode), "rgb,depth", UnknownNameError, r"join parts with '\+'"),
        (lambda options: make_env().reset(options=options), {"scene": 105}, OptionError, "'scene_id', got .'scene'"),
        (step, {"receiver": [0.0] * 9}, ActionError, "action of the giver must be 8 numbers, .* got None"),
        (lambda size: givers.make_giver_action(displacement=[0.0] * size), 2, ActionError, "displacement must be 3"),
        (check_receiver_action, None, ActionError, "got None; pass numbers for each agent"),
        (look_up, "nope", PolicyError, "failed: KeyError: 'nope'; the keys are time"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_messages_name_the_rule(
    function: Callable[[Any], object], argument: object, error: type[HandoverError], message: str
) -> None:
    with pytest.raises(error, match=message):
        function(argument)
