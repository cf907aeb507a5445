"""Options of commands: the fields of `EvaluationConfig` and `ExecutionConfig` that a command has."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from types import NoneType
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from handover_marl.config import OFFICIAL_CONFIG, WorldConfig
from handover_marl.episode.camera_observations import WRIST_ONLY
from handover_marl.episode.loop import InferenceTime
from handover_marl.errors import OptionError
from handover_marl.evaluation.config import REPLAY, EvaluationConfig, ExecutionConfig

_Value = TypeVar("_Value")
# Type of a field of a configuration that has no option on the command line.
_Hidden: TypeAlias = tyro.conf.Suppress[tyro.conf.Fixed[_Value]]
#: Policy of an agent.
PolicyName: TypeAlias = Annotated[str, tyro.conf.arg(metavar="POLICY")]
#: Folder that a command needs.
Folder = Annotated[str, tyro.conf.arg(metavar="DIR")]
# Options that several commands have; their types describe them.
DataDir = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="DIR", help="Data folder in HandoverSim's layout; default: the environment variable HANDOVER_MARL_DATA."
    ),
]
PopulationName = Annotated[
    str, tyro.conf.arg(metavar="NAME|FILE.json", help="Population of partners: a shipped one, or a file.")
]
Workers = Annotated[int | None, tyro.conf.arg(metavar="N", help="Number of worker processes; default: one per core.")]
Progress = Annotated[bool, tyro.conf.arg(help="Show a progress bar on stderr.")]
Trust = Annotated[bool, tyro.conf.arg(help="Allow files to name Python modules, whose code is then run.")]


#: Rules by which tyro parses options that are numbers.
OPTION_RULES = ConstructorRegistry()


@OPTION_RULES.primitive_rule
def make_number_option(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Return the parser of an option whose value is a number or a word of a `Literal`; None for other options."""
    types = get_args(info.type) or (info.type,)
    words = [word for part in types if get_origin(part) is Literal for word in get_args(part)]
    kinds = [part for part in types if part in (int, float)]
    if len(kinds) != 1 or any(get_origin(part) is not Literal and part not in (*kinds, NoneType) for part in types):
        return None
    (kind,) = kinds

    def parse(texts: list[str]) -> int | float | str | None:
        if texts[0] in words:
            return texts[0]
        if texts[0] == "None" and NoneType in types:
            return None
        try:
            number: int | float = kind(texts[0])
        except ValueError as error:
            valid = " or ".join(["a whole number" if kind is int else "a number", *words])
            raise OptionError(f"must be {valid}, got {texts[0]!r}") from error
        return number

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="|".join([kind.__name__.upper(), *words]),
        instance_from_str=parse,
        is_instance=lambda value: isinstance(value, (int, kind)) or value is None or value in words,
        str_from_instance=lambda value: [str(value)],
    )


@dataclass(frozen=True)
class TableArguments:
    """Options that configure printed tables.

    Attributes:
        style: Format of the printed tables.
        columns: Titles of columns; only tables that have all of them are printed, with only these columns.
    """

    style: Annotated[Literal["markdown", "csv", "latex"], tyro.conf.arg(name="format")] = "markdown"
    columns: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TITLE")] = ()


def parse_scenes(words: Sequence[str]) -> tuple[int, ...]:
    """Return the scene numbers in words such as "209" or "209,214"; raise `OptionError` for other words."""
    text = " ".join(words)
    try:
        return tuple(int(part) for part in text.replace(", ", ",").replace(" ", ",").split(","))
    except ValueError as error:
        raise OptionError(f"must be numbers separated by spaces or commas, such as 209,214, got {text!r}") from error


#: Scene numbers, separated by spaces or commas.
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


@dataclass(frozen=True)
class PairArguments(EvaluationConfig):
    """Options that configure scenes, policies and simulation; further cameras and rules can be set only in Python.

    Attributes:
        initial_joint_noise: Largest random deviation of each of the robot's seven initial arm joint positions (rad).
    """

    setup: Annotated[str | None, tyro.conf.arg(metavar="SETUP")] = None
    scenes: SceneNumbers = None
    data_dir: DataDir = None
    camera_noise: Annotated[str | None, tyro.conf.arg(metavar="CAMERA")] = None
    world_config: _Hidden[WorldConfig] = OFFICIAL_CONFIG
    cameras: _Hidden[Any] = WRIST_ONLY
    camera_randomization: _Hidden[Any] = None
    giver: PolicyName = REPLAY
    receiver: PolicyName = "yang2021"
    initial_joint_noise: Annotated[float, tyro.conf.arg(metavar="RAD")] = 0.0

    def __post_init__(self) -> None:
        """Do nothing: commands check the values, so that errors are printed without tyro's help text."""

    def get_fields(self) -> dict[str, Any]:
        """Return the fields of an `EvaluationConfig`; the noise of the joint positions is in its `world_config`."""
        values: dict[str, Any] = {part.name: getattr(self, part.name) for part in fields(EvaluationConfig)}
        if self.initial_joint_noise:
            values["world_config"] = WorldConfig(initial_joint_noise=self.initial_joint_noise)
        return values


@dataclass(frozen=True)
class SceneArguments(PairArguments):
    """Options that configure scenes and simulation."""

    giver: _Hidden[str] = REPLAY
    receiver: _Hidden[str] = "yang2021"


@dataclass(frozen=True)
class OfficialSceneArguments(SceneArguments):
    """Options that configure scenes and simulation under the official rules."""

    inference_time: _Hidden[InferenceTime] = None
    initial_joint_noise: _Hidden[float] = 0.0


@dataclass(frozen=True)
class ReceiverArguments(OfficialSceneArguments):
    """Options that configure scenes, the receiver and simulation under the official rules."""

    receiver: PolicyName = "yang2021"


@dataclass(frozen=True)
class RenderArguments(PairArguments):
    """Options of `render` that configure the scene and the giver."""

    split: _Hidden[str] = "test"
    scenes: _Hidden[tuple[int, ...] | None] = None
    receiver: _Hidden[str] = "yang2021"
    initial_joint_noise: _Hidden[float] = 0.0


@dataclass(frozen=True)
class ExecutionArguments(ExecutionConfig):
    """Options that configure workers and output."""

    def __post_init__(self) -> None:
        """Do nothing: commands check the values."""
