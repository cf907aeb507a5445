import inspect
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

import handover_marl
from handover_marl import EvaluationConfig, ExecutionConfig, HandoverEnv
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.constructors import single_agent_env
from handover_marl.errors import OptionError

RUN, EXECUTION = ({part.name for part in fields(kind)} for kind in (EvaluationConfig, ExecutionConfig))


def test_public_names_exist_and_have_types() -> None:
    for name in handover_marl.__all__:
        assert getattr(handover_marl, name) is not None
    with pytest.raises(AttributeError, match="nothing"):
        handover_marl.nothing  # noqa: B018
    stub = Path(handover_marl.__file__).with_suffix(".pyi").read_text()
    found = {name: module for module, name in re.findall(r"^from (\S+) import (\w+) as \2$", stub, re.MULTILINE)}
    assert found == {**handover_marl._MODULES, "__version__": "handover_marl.version"}


def test_a_program_beside_a_folder_of_the_same_name_imports_the_library_and_little_else(tmp_path: Path) -> None:
    (tmp_path / "handover_marl" / "docs").mkdir(parents=True)
    program = tmp_path / "program.py"
    heavy = "('torch', 'pybullet', 'scipy', 'stable_baselines3')"
    program.write_text(
        f"import sys, handover_marl\nassert not [name for name in {heavy} if name in sys.modules]\n"
        "handover_marl.parallel_env\n"
    )
    subprocess.run([sys.executable, str(program)], cwd=tmp_path, check=True)


# Options that functions that render one scene do not have. Their option `out` is the path of the picture.
NOT_OF_A_SCENE = {"workers", "backend", "ray_address", "shard", "fresh", "replays"}


@pytest.mark.parametrize(
    ("function", "own", "left_out"),
    [
        (handover_marl.benchmark, {"execution"}, {"giver", "world_config"}),
        (handover_marl.evaluate_pair, {"execution"}, set()),
        (handover_marl.compare_physics, {"execution", "against"}, set()),
        (handover_marl.demonstrate, {"execution", "obs_mode", "keep", "fps"}, set()),
        (handover_marl.crossplay, {"execution", "givers", "receivers"}, {"giver", "receiver"}),
        (
            handover_marl.render_scene,
            {"scene_id", "out", "key_frames", "camera", "view", "caption"},
            {"setup", "split", "scenes", *NOT_OF_A_SCENE},
        ),
        (
            handover_marl.render_plan,
            {"scene_id", "out", "camera"},
            {"setup", "split", "scenes", *NOT_OF_A_SCENE, "progress"},
        ),
    ],
)
def test_signatures_show_every_option(function: Callable[..., Any], own: set[str], left_out: set[str]) -> None:
    """Signatures name every option, so that completion and help show it, although it is passed on as a keyword."""
    shown = inspect.signature(function).parameters
    assert shown.keys() == (RUN | EXECUTION | own) - left_out
    defaults = {part.name: part.default for kind in (EvaluationConfig, ExecutionConfig) for part in fields(kind)}
    chosen = {"split", "receiver", "out"}  # some of the functions have other defaults
    for name in shown.keys() - own - chosen:
        assert shown[name].default == defaults[name], name


def test_constructors_show_every_field_of_the_configuration() -> None:
    fields_shown = inspect.signature(EnvConfig).parameters
    for function, own in (
        (HandoverEnv, {"config"}),
        (handover_marl.parallel_env, {"config"}),
        (handover_marl.env, {"config"}),
        (single_agent_env, {"agent", "config", "partner", "trust"}),
    ):
        shown = inspect.signature(function).parameters
        assert shown.keys() == fields_shown.keys() | own
        for name, part in fields_shown.items():
            assert (shown[name].default, shown[name].annotation) == (part.default, part.annotation), name


def test_a_configuration_stands_alone() -> None:
    config = EnvConfig(dataset="synthetic", scenes=iter([5, 6]))
    env = handover_marl.parallel_env(config)
    assert env.config == replace(config, setup="s0")
    assert env.scene_ids == config.scenes == (5, 6)
    with pytest.raises(OptionError, match="not both"):
        handover_marl.parallel_env(config, split="val")
    with pytest.raises(OptionError, match="prescribes physics"):
        handover_marl.benchmark_env(physics="fast")
