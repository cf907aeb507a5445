import inspect
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import pytest

import handover_marl
from handover_marl import Execution, HandoverEnv, Run
from handover_marl.envs.constructors import EnvOptions, giver_env, receiver_env
from handover_marl.run import RunOptions, SceneOptions

RUN, EXECUTION = ({part.name for part in fields(kind)} for kind in (Run, Execution))


def test_public_names_exist() -> None:
    for name in handover_marl.__all__:
        assert getattr(handover_marl, name) is not None
    with pytest.raises(AttributeError, match="nothing"):
        handover_marl.nothing  # noqa: B018


def test_import_is_light() -> None:
    heavy = "('torch', 'pybullet', 'scipy', 'stable_baselines3')"
    code = f"import sys, handover_marl; print([name for name in {heavy} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


# `out` of a picture is its own.
NOT_OF_A_SCENE = {"workers", "backend", "ray_address", "shard", "fresh", "replays"}


def parameters(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    shown = inspect.signature(function).parameters
    assert not any(part.kind in (part.VAR_KEYWORD, part.VAR_POSITIONAL) for part in shown.values())
    return dict(shown)


@pytest.mark.parametrize(
    ("function", "own", "left_out"),
    [
        (handover_marl.benchmark, {"execution"}, {"giver", "config"}),
        (handover_marl.evaluate_pair, {"execution"}, set()),
        (handover_marl.agreement, {"execution", "against"}, set()),
        (handover_marl.demonstrate, {"execution", "sight", "observe", "keep"}, set()),
        (handover_marl.crossplay, {"execution", "givers", "receivers"}, {"giver", "receiver"}),
        (
            handover_marl.render_scene,
            {"scene_id", "out", "key_frames", "camera", "view"},
            {"setup", "split", "scenes", "config", *NOT_OF_A_SCENE},
        ),
        (
            handover_marl.render_plan,
            {"scene_id", "out", "camera"},
            {"setup", "split", "scenes", "config", *NOT_OF_A_SCENE, "progress"},
        ),
    ],
)
def test_signatures_show_every_option(function: Callable[..., Any], own: set[str], left_out: set[str]) -> None:
    """Which completion and help show, though functions pass them on as keywords."""
    shown = parameters(function)
    assert shown.keys() == (RUN | EXECUTION | own) - left_out
    defaults = {part.name: part.default for kind in (Run, Execution) for part in fields(kind)}
    chosen = {"split", "receiver", "out"}  # by some of the functions themselves
    for name in shown.keys() - own - chosen:
        assert shown[name].default == defaults[name], name


def test_typed_options_are_the_fields_of_a_run_and_its_execution() -> None:
    named = {"setup", "split", "giver", "receiver"}
    assert RunOptions.__optional_keys__ | named == RUN | EXECUTION
    assert not RunOptions.__required_keys__
    assert SceneOptions.__optional_keys__ < RunOptions.__optional_keys__
    assert SceneOptions.__optional_keys__ <= parameters(handover_marl.render_scene).keys()


def test_typed_options_are_the_parameters_of_the_environment() -> None:
    taken = parameters(HandoverEnv)
    assert EnvOptions.__optional_keys__ == taken.keys()
    assert not EnvOptions.__required_keys__
    for function, own in (
        (handover_marl.parallel_env, set()),
        (handover_marl.env, set()),
        (receiver_env, {"partner", "trust"}),
        (giver_env, {"partner", "trust"}),
    ):
        shown = parameters(function)
        assert shown.keys() == taken.keys() | own
        for name, part in taken.items():
            assert (shown[name].default, shown[name].annotation) == (part.default, part.annotation), name
