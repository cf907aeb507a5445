"""Signatures of public functions, checks of their arguments, and queries of packages and processor cores."""

import functools
import importlib.util
import inspect
import os
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, cast

import loky
import numpy as np

from handover_marl.errors import OptionError, UnknownArgumentError
from handover_marl.execution.files import shorten_text

_Function = TypeVar("_Function", bound=Callable[..., Any])

# Largest length (bytes) of the name of a file or folder in usual file systems.
_LONGEST_NAME = 255


def forward_signature(
    *sources: Callable[..., Any],
    without: Mapping[str, str] = MappingProxyType({}),
    defaults: Mapping[str, Any] = MappingProxyType({}),
) -> Callable[[_Function], _Function]:
    """Return a decorator that replaces `**keywords` in a function's signature by the parameters of `sources`.

    Help, documentation and editors then list these parameters. Other keywords raise `UnknownArgumentError`.

    Args:
        sources: Functions or dataclasses with the parameters.
        without: Parameters of `sources` that the function does not offer, each with advice for the user. A value other
            than their default raises an `OptionError` with this advice.
        defaults: Defaults that replace those of the sources.
    """

    def decorate(function: _Function) -> _Function:
        signature = inspect.signature(function)
        own = [part for part in signature.parameters.values() if part.kind is not part.VAR_KEYWORD]
        parts = {name: part for source in sources for name, part in inspect.signature(source).parameters.items()}
        excluded = {part.name for part in own} | set(without)
        forwarded = [
            part.replace(kind=part.KEYWORD_ONLY, default=defaults.get(part.name, part.default))
            for part in parts.values()
            if part.name not in excluded
        ]
        names = [part.name for part in (*own, *forwarded)]

        @functools.wraps(function)
        def check_keywords(*args: Any, **keywords: Any) -> Any:
            for name, value in keywords.items():
                if name in without and value != parts[name].default:
                    given = f"got {shorten_text(value)}; {without[name]}"
                    raise OptionError(f"{name} must be left out of {function.__qualname__}(), {given}")
                if name not in names and name not in without:
                    raise UnknownArgumentError(function.__qualname__, name, names)
            return function(*args, **keywords)

        check_keywords.__signature__ = signature.replace(parameters=[*own, *forwarded])  # type: ignore[attr-defined]
        return cast(_Function, check_keywords)

    return decorate


def count_available_cores() -> int:
    """Return the number of cores that this process may use, with the limits of containers and LOKY_MAX_CPU_COUNT."""
    return int(loky.cpu_count())


def resolve_worker_count(workers: int | None) -> int:
    """Return `workers`, or one per available core for None; raise `OptionError` unless it is a positive integer."""
    return count_available_cores() if workers is None else check_positive_integer("workers", workers)


@dataclass(frozen=True)
class PoolConfig:
    """Configuration of a worker pool.

    Attributes:
        workers: Number of worker processes; default: one per core. Results contain this number, since it affects
            planning times, which are wall-clock times.
        ray_address: Address of the Ray cluster whose nodes run the workers, as in `ray.init`: host:port, "auto" for the
            cluster in RAY_ADDRESS or on this machine, or "local" to start one; default: no Ray, but local processes.
    """

    workers: int | None = None
    ray_address: str | None = None


def check_path(name: str, path: object) -> Path:
    """Return a path with `~` expanded; raise `OptionError` if the value of the option `name` is no path."""
    try:
        text = os.fsdecode(path)  # type: ignore[arg-type]
        if not text or "\0" in text:
            raise ValueError("it is empty" if not text else "it has a zero byte")
        if any(len(os.fsencode(part)) > _LONGEST_NAME for part in Path(text).parts):
            raise ValueError(f"a part of it has more than {_LONGEST_NAME} bytes")
        return Path(text).expanduser()
    except (TypeError, ValueError, RuntimeError) as error:
        raise OptionError(f"{name} must be a path, got {str(path)[:80]!r} ({error})") from error


def check_positive_integer(name: str, value: object) -> int:
    """Return a value as int; raise `OptionError` if the option `name` is not an integer of at least 1."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise OptionError(f"{name} must be an integer of at least 1, got {value!r}")
    return int(value)


def check_boolean(name: str, value: object) -> None:
    """Raise `OptionError` unless the value of the option `name` is True or False; a text like "no" would be truthy."""
    if not isinstance(value, bool):
        raise OptionError(f"{name} must be True or False, got {value!r}")


def is_installed(module: str) -> bool:
    """Check whether a top-level module is installed; a module in the working directory does not count."""
    spec = importlib.util.find_spec(module)
    # Folders without __init__.py have no origin.
    return spec is not None and spec.origin is not None and Path.cwd() not in Path(spec.origin).parents[:2]


def is_pybullet_installed() -> bool:
    """Check whether PyBullet is installed, which has no wheels for Python after 3.13."""
    return is_installed("pybullet")


def require_modules(feature: str, extra: str, *modules: str, advice: str = "") -> None:
    """Raise OptionError if a module is missing: "FEATURE needs MODULE: pip install 'handover-marl[EXTRA]'ADVICE"."""
    missing = [module for module in modules if not is_installed(module)]
    if missing:
        raise OptionError(f"{feature} needs {' and '.join(missing)}: pip install 'handover-marl[{extra}]'{advice}")


def require_pybullet(feature: str, advice: str) -> None:
    """Raise OptionError if PyBullet is not installed; the message names the `feature` and ends in `advice`."""
    if not is_pybullet_installed():
        raise OptionError(
            f"{feature} needs PyBullet, which is not installed (it has wheels up to Python 3.13); {advice}"
        )


def describe_machine() -> str:
    """Return this machine's processor, number of cores and version of Python as text."""
    return f"{_read_processor_name()}, {count_available_cores()} cores, Python {platform.python_version()}"


def _read_processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor() or platform.machine() or "unknown processor")
