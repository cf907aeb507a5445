"""Command-line options made from the fields of `EvaluationConfig` and `ExecutionConfig`."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Annotated, Any, Literal

import tyro
from docstring_parser import parse
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from handover_marl.config import WorldConfig
from handover_marl.errors import HandoverError, OptionError
from handover_marl.evaluation.config import MULTI_SCENE_FIELDS, EvaluationConfig, ExecutionConfig

#: Rules with which tyro builds options from configurations.
registry = ConstructorRegistry()


class BenchmarkArguments(EvaluationConfig):
    """Options of `benchmark`, whose giver is fixed."""


class CrossPlayArguments(EvaluationConfig):
    """Options of `crossplay`, which takes lists of policies."""


class StrangersArguments(EvaluationConfig):
    """Options of `strangers`, which takes its policies as options of its own."""


class RenderArguments(EvaluationConfig):
    """Options of `render` that configure the scene."""


class RenderExecutionArguments(ExecutionConfig):
    """Options of `render` that configure the execution."""


#: Field of `WorldConfig` with an option; others can be set only in Python.
_NOISE = "initial_joint_noise"
# Fields without an option.
_HIDDEN_FIELDS: dict[type, tuple[str, ...]] = {
    EvaluationConfig: ("world_config",),
    BenchmarkArguments: ("world_config", "giver"),
    CrossPlayArguments: ("world_config", "giver", "receiver"),
    StrangersArguments: ("world_config", "giver", "receiver"),
    RenderArguments: ("world_config", "setup", "split", "scenes", "receiver"),
    ExecutionConfig: (),
    RenderExecutionArguments: MULTI_SCENE_FIELDS,
}
# The official protocol has no noise, and videos show single scenes.
_WITH_NOISE = (EvaluationConfig, CrossPlayArguments)


def parse_scenes(words: Sequence[str]) -> tuple[int, ...]:
    """Return the scene numbers in words such as "209" or "209,214".

    Raises:
        OptionError: A part of a word is not a number.
    """
    text = " ".join(words)
    try:
        return tuple(int(part) for part in text.replace(", ", ",").replace(" ", ",").split(","))
    except ValueError as error:
        raise OptionError(f"must be numbers separated by spaces or commas, such as 209,214, got {text!r}") from error


#: Type of an option with scene numbers, separated by spaces or commas.
SceneNumbers = Annotated[
    tuple[int, ...] | None,
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="N [N ...]",
        instance_from_str=parse_scenes,
        is_instance=lambda value: value is None or isinstance(value, tuple),
        str_from_instance=lambda value: ["None"] if value is None else list(map(str, value)),
    ),
]
#: Type of the option --population.
PopulationName = Annotated[str, tyro.conf.arg(metavar="NAME|FILE.json")]
_OPTION_TYPES: dict[str, Any] = {
    "setup": Annotated[str | None, tyro.conf.arg(metavar="SETUP")],
    "giver": Annotated[str, tyro.conf.arg(metavar="POLICY")],
    "receiver": Annotated[str, tyro.conf.arg(metavar="POLICY")],
    "scenes": SceneNumbers,
    _NOISE: Annotated[float, tyro.conf.arg(metavar="RAD")],
    # Other noise models can be configured only in Python.
    "camera_noise": Annotated[str | None, tyro.conf.arg(metavar="CAMERA")],
    "data_dir": Annotated[str | None, tyro.conf.arg(metavar="DIR")],
    "out": Annotated[str | None, tyro.conf.arg(metavar="DIR")],
    "workers": Annotated[int | None, tyro.conf.arg(metavar="N")],
    "backend": Literal["local", "ray"],
    "ray_address": Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")],
    "shard": Annotated[str | None, tyro.conf.arg(metavar="K/N")],
    "replays": Literal["none", "failed", "all"],
}


@registry.struct_rule
def _struct_spec_from_config(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Return the options of a configuration: its visible fields, with help from its docstring."""
    if info.type not in _HIDDEN_FIELDS:
        return None
    config_class: Any = EvaluationConfig if issubclass(info.type, EvaluationConfig) else ExecutionConfig
    default = info.default if isinstance(info.default, config_class) else config_class()
    descriptions = {part.arg_name: part.description for part in parse(config_class.__doc__ or "").params}
    visible = [part for part in fields(config_class) if part.name not in _HIDDEN_FIELDS[info.type]]
    return StructConstructorSpec(
        instantiate=_make_evaluation_config if config_class is EvaluationConfig else _make_execution_config,
        fields=tuple(
            StructFieldSpec(
                part.name,
                _OPTION_TYPES.get(part.name, part.type),
                getattr(default, part.name),
                descriptions.get(part.name),
            )
            for part in visible
        )
        + (_make_noise_options() if info.type in _WITH_NOISE else ()),
    )


def _make_noise_options() -> tuple[StructFieldSpec, ...]:
    """Return the option of the noise of the robot's initial joint positions."""
    descriptions = {part.arg_name: part.description for part in parse(WorldConfig.__doc__ or "").params}
    return (StructFieldSpec(_NOISE, _OPTION_TYPES[_NOISE], 0.0, descriptions.get(_NOISE)),)


class ArgumentError(HandoverError):
    """Invalid option, reported without the help text that tyro adds to other errors."""


def _make_evaluation_config(initial_joint_noise: float = 0.0, **options: Any) -> EvaluationConfig:
    with _report_directly():
        if initial_joint_noise:
            options["world_config"] = WorldConfig(initial_joint_noise=initial_joint_noise)
        return EvaluationConfig(**options)


def _make_execution_config(**options: Any) -> ExecutionConfig:
    with _report_directly():
        return ExecutionConfig(**options)


@contextlib.contextmanager
def _report_directly() -> Iterator[None]:
    try:
        yield
    except OptionError as error:
        raise ArgumentError(str(error)) from error
