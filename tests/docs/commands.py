"""Shell commands of the documentation: functions that parse and check them without running them."""

import functools
import importlib.util
import inspect
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import tyro

from handover_marl.cli import main, program
from handover_marl.datasets.splits import check_setup_and_split
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.policies.reference import parse_policy, split_policy_list
from tests.docs.pages import REPOSITORY
from tests.setup_file import read_setup

_PYTHONS = ("python", ".venv/bin/python")
_SHELL = ("cd", "done", "git", "pytest", "tar")


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of every command in a block; of loops those of the first iteration."""
    variables: dict[str, str] = {}
    for line in text.replace("\\\n", " ").splitlines():
        for part in re.split(r";\s+", line.strip()):
            words = shlex.split(part, comments=True)
            if ">" in words:
                words = words[: words.index(">")]
            if words[:1] == ["do"]:
                words = words[1:]
            if words[:1] == ["for"]:
                variables[words[1]] = words[3]
            elif words:
                yield [re.sub(r"\$(\w+)", lambda match: variables[match[1]], word) for word in words]


def check(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that the program that a command calls exists and accepts the arguments."""
    first, rest = words[0], words[1:]
    if first == "handover-marl":
        _check_own(rest, monkeypatch)
    elif first == "make":
        makefile = (REPOSITORY / "Makefile").read_text()
        for word in rest:
            known = f"^{word.partition('=')[0]} \\?=|^DATASET.*\\$\\(DATA\\)" if "=" in word else f"^{word}:"
            assert re.search(known, makefile, re.MULTILINE), f"make knows no {word}"
    elif first in _PYTHONS and rest[0] == "-m":
        assert rest[1] == "pytest" or importlib.util.find_spec(rest[1]), f"there is no module {rest[1]}"
    elif first in _PYTHONS:
        _check_script(REPOSITORY / rest[0], rest[1:], monkeypatch)
    elif first == "pip":
        for extras in re.findall(r"\[([\w,]+)\]", " ".join(rest)):
            assert set(extras.split(",")) <= set(read_setup()["options.extras_require"])
    else:
        assert first in _SHELL, f"{first} is no command that is known here"


def _check_own(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that the library's command line accepts the arguments, and that the named setups and policies exist."""
    if len(arguments) == 1 or arguments[1:] == ["--help"]:  # the text only names the command
        with pytest.raises(SystemExit, match="0"):
            main([arguments[0], "--help"])
        return
    called: list[Mapping[str, Any]] = []

    def capture(run: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(run)
        def note(*args: Any, **kwargs: Any) -> int:
            called.append(inspect.signature(run).bind(*args, **kwargs).arguments)
            return 0

        return note

    with monkeypatch.context() as patch:
        for group in ("_COMMANDS", "_SCENE_COMMANDS"):
            patch.setattr(program, group, tuple(map(capture, getattr(program, group))))
        try:
            status = main(arguments)
        except SystemExit as refusal:
            raise AssertionError(f"handover-marl {shlex.join(arguments)} is refused") from refusal
    assert (status, len(called)) == (0, 1)
    for name, value in called[0].items():
        config = value.make_config() if hasattr(value, "make_config") else None
        if isinstance(config, EvaluationConfig):
            # Other data sets define other setups.
            is_official = config.setup is not None and ":" not in config.dataset
            check_setup_and_split(config.setup if config.setup and is_official else "s0", config.split)
            for agent in ("giver", "receiver"):
                parse_policy(agent, getattr(config, agent))
        agent = name.removesuffix("s")
        if agent in ("giver", "receiver") and value is not None and "my_package" not in value:
            for policy in split_policy_list(agent, value):
                parse_policy(agent, policy)


def _check_script(path: Path, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that a script exists and accepts the arguments; skip one that needs a library that is not installed."""
    described = re.search(r"tyro\.cli\((\w+)[,)]", path.read_text())
    assert described, f"{path.name} takes no arguments"
    monkeypatch.syspath_prepend(str(path.parent))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, path.stem, module)
    try:
        spec.loader.exec_module(module)
    except ModuleNotFoundError as error:
        pytest.skip(str(error))
    try:
        tyro.cli(getattr(module, described[1]), args=arguments)
    except SystemExit as refusal:
        raise AssertionError(f"{path.name} {shlex.join(arguments)} is refused") from refusal
