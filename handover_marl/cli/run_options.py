"""`Run` and `Execution` as options of commands, so that what a run is stands in one place."""

import os
from dataclasses import fields, replace
from typing import Annotated, Any, Literal

import tyro
from docstring_parser import parse
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from handover_marl.errors import OptionError
from handover_marl.run import OF_SEVERAL, Execution, Run

#: How descriptions of runs become options.
registry = ConstructorRegistry()


class BenchmarkRun(Run):
    """What the official protocol leaves open."""


class CrossPlayRun(Run):
    """A run whose policies are named apart."""


class SceneRun(Run):
    """What is shown of one scene."""


class SceneExecution(Execution):
    """How one scene is shown."""


# Fields that the command line does not have, by description. A world of one's own is described in Python.
_HIDDEN: dict[type, tuple[str, ...]] = {
    Run: ("config",),
    BenchmarkRun: ("config", "giver"),
    CrossPlayRun: ("config", "giver", "receiver"),
    SceneRun: ("config", "setup", "split", "scenes", "receiver"),
    Execution: (),
    SceneExecution: OF_SEVERAL,
}
_WORDS: dict[str, Any] = {
    "giver": Annotated[str, tyro.conf.arg(metavar="POLICY")],
    "receiver": Annotated[str, tyro.conf.arg(metavar="POLICY")],
    "scenes": Annotated[str | None, tyro.conf.arg(metavar="N,N,...")],
    # A camera of one's own is described in Python.
    "imperfections": Annotated[str | None, tyro.conf.arg(metavar="CAMERA")],
    "data_dir": Annotated[str | None, tyro.conf.arg(metavar="DIR")],
    "out": Annotated[str | None, tyro.conf.arg(metavar="DIR")],
    "workers": Annotated[int | None, tyro.conf.arg(metavar="N")],
    "backend": Literal["local", "ray"],
    "ray_address": Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")],
    "shard": Annotated[str | None, tyro.conf.arg(metavar="K/N")],
    "replays": Literal["none", "failed", "all"],
}


@registry.struct_rule
def _described(info: StructTypeInfo) -> StructConstructorSpec | None:
    """`Run` and `Execution` as options: their fields, with what their docstrings say."""
    if info.type not in _HIDDEN:
        return None
    kind: Any = Run if issubclass(info.type, Run) else Execution
    default = info.default if isinstance(info.default, kind) else kind()
    said = {part.arg_name: part.description for part in parse(kind.__doc__ or "").params}
    shown = [part for part in fields(kind) if part.name not in _HIDDEN[info.type]]
    return StructConstructorSpec(
        instantiate=_make_run if kind is Run else Execution,
        fields=tuple(
            StructFieldSpec(
                part.name, _WORDS.get(part.name, part.type), getattr(default, part.name), said.get(part.name)
            )
            for part in shown
        ),
    )


class ToldError(Exception):
    """What tyro is not to tell in its own way."""


def _make_run(**told: Any) -> Run:
    try:
        scenes = parse_scenes(told.pop("scenes", None))
    except OptionError as error:
        raise ToldError(str(error)) from error
    return Run(scenes=None if scenes is None else tuple(scenes), **told)


def parse_scenes(text: str | None) -> list[int] | None:
    """Scene numbers from a comma-separated list; None stays None.

    Raises:
        OptionError: Something in the list is not a number.
    """
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise OptionError(f"--scenes takes scene numbers separated by commas, such as 209,214, not {text!r}") from error


def expanded(how: Execution) -> Execution:
    """The same with ~ in its folder made out."""
    return how if how.out is None else replace(how, out=os.path.expanduser(how.out))  # noqa: PTH111  (stays text)
