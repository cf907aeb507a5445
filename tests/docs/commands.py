"""Shell commands of the documentation: functions that parse and check them without running their slow parts."""

import configparser
import importlib
import importlib.util
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
import tyro

from handover_marl.cli import main
from handover_marl.datasets.splits import check_setup_and_split
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.policies.reference import parse_policy
from tests.docs.pages import REPOSITORY

#: Functions that the commands of the library call; they are replaced by a mock.
TARGETS = (
    "handover_marl.evaluation.comparison.compare_physics",
    "handover_marl.evaluation.comparison.compare",
    "handover_marl.evaluation.crossplay.crossplay",
    "handover_marl.evaluation.reports.report.evaluate",
    "handover_marl.evaluation.benchmark.benchmark",
    "handover_marl.evaluation.benchmark.evaluate_pair",
    "handover_marl.assets.building.custom_scenes.CustomSceneFolder",
    "handover_marl.datasets.dexycb.importer.import_dexycb",
    "handover_marl.evaluation.demonstrations.record.demonstrate",
    "handover_marl.evaluation.demonstrations.convert.convert_to_lerobot",
    "handover_marl.evaluation.demonstrations.convert.convert_to_minari",
    "handover_marl.cli.data_folders.check_data_folder",
    "handover_marl.evaluation.merge.merge",
    "handover_marl.evaluation.rendering.render_plan",
    "handover_marl.evaluation.rendering.render_scene",
    "handover_marl.evaluation.strangers.protocol.make_leaderboard",
    "handover_marl.evaluation.strangers.protocol.strangers",
    "handover_marl.evaluation.strangers.protocol.update_references",
    "handover_marl.evaluation.verification.verify",
)
#: Functions that would check or write files that a command names, and the values that their replacements return.
NOT_WRITTEN = {
    "handover_marl.visualization.video.check_output_path": Path("episodes.csv"),
    "handover_marl.cli.folders.write_atomically": None,
}
_PYTHONS = ("python", ".venv/bin/python")
_SHELL = ("cd", "done", "git", "pytest", "tar")


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of every command in a block; of loops those of the first iteration."""
    variables: dict[str, str] = {}
    for line in text.replace("\\\n", " ").splitlines():
        if computed := re.fullmatch(r"(\w+)=\$\((.*)\)", line.strip()):
            variables[computed[1]] = _run_python(computed[2])
            continue
        for part in re.split(r";\s+", line.strip()):
            words = shlex.split(part, comments=True)
            if ">" in words:
                words = words[: words.index(">")]
            if words[:1] == ["do"]:
                words = words[1:]
            if words[:1] == ["for"]:
                variables[words[1]] = words[3]
            elif words:
                yield [filled for word in words for filled in _fill_in(word, variables)]


def _run_python(command: str) -> str:
    """Return the output of `python -c "..."`."""
    python, *arguments = shlex.split(command)
    assert python in _PYTHONS
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=True).stdout.strip()


def _fill_in(word: str, variables: dict[str, str]) -> list[str]:
    """Return a word with values for variables, split where the word is only a variable, as a shell does."""
    filled = re.sub(r"\$(\w+)", lambda match: variables[match[1]], word)
    return filled.split() if re.fullmatch(r"\$\w+", word) else [filled]


def check(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that the program that a command calls exists and accepts the arguments."""
    first, rest = words[0], words[1:]
    if first == "handover-marl":
        _check_own(rest, monkeypatch)
    elif first == "make":
        _check_make(rest)
    elif first in _PYTHONS and rest[0] == "-m":
        assert rest[1] == "pytest" or importlib.util.find_spec(rest[1]), f"there is no module {rest[1]}"
    elif first in _PYTHONS:
        _check_script(REPOSITORY / rest[0], rest[1:], monkeypatch)
    elif first == "pip":
        _check_extras(rest)
    else:
        assert first in _SHELL, f"{first} is no command that is known here"


def _check_own(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that the library's command line accepts the arguments, and that the named setups and policies exist."""
    if len(arguments) == 1 or arguments[1:] == ["--help"]:  # the text only names the command
        with pytest.raises(SystemExit, match="0"):
            main([arguments[0], "--help"])
        return
    called: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def note(*args: Any, **kwargs: Any) -> MagicMock:
        called.append((args, kwargs))
        return MagicMock()

    # Import all modules first: a module that is imported while others are patched would keep the mocks.
    for target in (*TARGETS, *NOT_WRITTEN):
        importlib.import_module(target.rpartition(".")[0])
    with monkeypatch.context() as patch:
        for target in TARGETS:
            patch.setattr(target, note)
        for target, result in NOT_WRITTEN.items():
            patch.setattr(target, lambda *_, result=result: result)
        try:
            status = main(arguments)
        except SystemExit as refusal:
            raise AssertionError(f"handover-marl {shlex.join(arguments)} is refused") from refusal
    assert status == 0
    assert len(called) == 1
    args, kwargs = called[0]
    for value in (*args, *kwargs.values()):
        if isinstance(value, EvaluationConfig):
            # Other data sets define other setups.
            is_official = value.setup is not None and ":" not in value.dataset
            check_setup_and_split(value.setup if value.setup and is_official else "s0", value.split)
            for agent in ("giver", "receiver"):
                parse_policy(agent, getattr(value, agent))
    if arguments[0] == "crossplay":
        for agent, policies in zip(("giver", "receiver"), args[:2], strict=True):
            for policy in policies:
                parse_policy(agent, policy)
    if kwargs.get("receiver") is not None:
        parse_policy("receiver", kwargs["receiver"])


def _check_script(path: Path, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that a script exists and accepts the arguments."""
    source = path.read_text()
    described = re.search(r"tyro\.cli\((\w+)[,)]", source)
    assert described, f"{path.name} takes no arguments"
    monkeypatch.syspath_prepend(str(path.parent))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, path.stem, module)
    spec.loader.exec_module(module)
    try:
        tyro.cli(getattr(module, described[1]), args=arguments)
    except SystemExit as refusal:
        raise AssertionError(f"{path.name} {shlex.join(arguments)} is refused") from refusal


def _check_make(words: list[str]) -> None:
    makefile = (REPOSITORY / "Makefile").read_text()
    for word in words:
        known = f"^{word.partition('=')[0]} \\?=|^DATASET.*\\$\\(DATA\\)" if "=" in word else f"^{word}:"
        assert re.search(known, makefile, re.MULTILINE), f"make knows no {word}"


def _check_extras(words: list[str]) -> None:
    assert words[0] == "install"
    setup = configparser.ConfigParser()
    setup.read(REPOSITORY / "setup.cfg")
    for extras in re.findall(r"\[([\w,]+)\]", " ".join(words)):
        assert set(extras.split(",")) <= set(setup["options.extras_require"])
