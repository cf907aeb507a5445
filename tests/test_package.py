import inspect
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

import handover_marl
from handover_marl import EvaluationConfig, ExecutionConfig
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.constructors import single_agent_env


def test_public_names_exist_and_have_types() -> None:
    for name in handover_marl.__all__:
        assert getattr(handover_marl, name) is not None
    with pytest.raises(AttributeError, match="nothing"):
        handover_marl.nothing  # noqa: B018
    assert {"__version__", "givers", "receivers", "testing", "vector_env"} <= {*handover_marl.__all__}


def test_a_program_beside_a_folder_of_the_same_name_imports_the_library_and_little_else(tmp_path: Path) -> None:
    (tmp_path / "handover_marl" / "docs").mkdir(parents=True)
    program = tmp_path / "program.py"
    heavy = "('torch', 'pybullet', 'scipy', 'stable_baselines3')"
    program.write_text(
        f"import sys, handover_marl\nassert not [name for name in {heavy} if name in sys.modules]\n"
        "handover_marl.parallel_env\n"
    )
    subprocess.run([sys.executable, str(program)], cwd=tmp_path, check=True)


@pytest.mark.parametrize(
    ("function", "left_out"),
    [
        (handover_marl.benchmark, {"giver", "world_config", "inference_time"}),
        (handover_marl.evaluate_pair, set()),
        (handover_marl.demonstrate, set()),
        (handover_marl.crossplay, {"giver", "receiver"}),
        (handover_marl.render_scene, {"split", "scenes"}),
    ],
)
def test_signatures_show_every_option(function: Callable[..., Any], left_out: set[str]) -> None:
    """Signatures name every option, so that completion and help show it, although it is passed on as a keyword."""
    shown = inspect.signature(function).parameters
    assert not any(part.kind is part.VAR_KEYWORD for part in shown.values())
    assert {part.name for part in fields(EvaluationConfig)} - shown.keys() == left_out
    defaults = {part.name: part.default for kind in (EvaluationConfig, ExecutionConfig) for part in fields(kind)}
    # Some of the functions have another default of the split, the receiver or the output.
    for name in shown.keys() & defaults.keys() - {"split", "receiver", "out"}:
        assert shown[name].default == defaults[name], name


@pytest.mark.parametrize(
    ("function", "own"),
    [
        (handover_marl.parallel_env, set()),
        (handover_marl.env, set()),
        (single_agent_env, {"agent", "partner", "trust"}),
    ],
)
def test_constructors_show_every_field_of_the_configuration(function: Callable[..., Any], own: set[str]) -> None:
    shown, expected = inspect.signature(function).parameters, inspect.signature(EnvConfig).parameters
    assert shown.keys() == expected.keys() | own
    for name, part in expected.items():
        assert (shown[name].default, shown[name].annotation) == (part.default, part.annotation), name
