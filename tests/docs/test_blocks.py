"""Tests of all code blocks of the documentation, on a few short synthetic scenes or on generated data."""

import functools
import importlib.util
import inspect
import linecache
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import tyro

import handover_marl
from handover_marl import testing
from handover_marl.cli import main, program
from handover_marl.cli.options import PairArguments
from handover_marl.datasets.splits import choose_scenes, get_prescribed_side, list_split_scenes
from handover_marl.errors import HandoverError
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.policies.reference import parse_policy
from tests.docs.pages import PAGES, REPOSITORY, Block, blocks, inline_commands, name
from tests.helpers.fake_layout import FakeScene, write_layout
from tests.helpers.setup_file import read_setup
from tests.helpers.short_episodes import shorten_episodes
from tests.learning.training.scripts import import_file

LANGUAGES = {"python", "bash", "ini", "text", "bibtex", "{include}", "{toctree}", "{eval-rst}"}
SHELL = [
    pytest.param(block, id=f"{name(page)}:{block.line}")
    for page in PAGES
    for block in (*blocks(page, "bash"), *inline_commands(page))
]
OWN_OBJECT = REPOSITORY / "docs" / "tutorials" / "own_object.md"
PROGRAMS = [page for page in PAGES if blocks(page, "python") and page != OWN_OBJECT]
#: Modules that programs need, by parts of their text.
NEEDS = {
    "vector_env(": "mujoco",
    "make_vec(": "mujoco",
    'physics="mujoco"': "mujoco",
    "obs_mode=": "embreex",
    'backend="warp"': "mujoco_warp",
    "from stable_baselines3": "stable_baselines3",
    "import torch": "torch",
    "torchrl": "torchrl",
    ".html": "viser",
}
#: Modules that only the environment of `make loops` has, by parts of the blocks that need them.
LOOPS = {"from ray.rllib": "tree", "from tianshou": "tianshou", "from benchmarl": "benchmarl"}
ENVIRONMENTS, DECISIONS = 2, 4
#: Pages whose programs need what happens late in an episode: a decision of the giver.
WITH_GIVERS = ("docs/tutorials/own_giver.md",)
#: Physics steps (1 ms) of episodes of other pages, and of conformance tests of receivers and of givers; episodes of
#: pages with givers are as long as the latter.
EPISODE_STEPS, RECEIVER_STEPS, GIVER_STEPS = 500, 300, 3500
#: Parts of programs, and what the test runs in their place, so that less is simulated and fewer processes start.
#: Kernels of MuJoCo Warp for three environments are compiled for other tests, too.
SMALLER = {
    "episode.steps[:-1]": "episode.steps[:4]",
    "    64, ": f"    {ENVIRONMENTS}, ",
    "vector_env(64, ": f"vector_env({ENVIRONMENTS}, ",
    "zeros((64, ": f"zeros(({ENVIRONMENTS}, ",
    "    8, ": "    3, ",
    "vector_env(4, ": "vector_env(3, ",
    "512": "32",
    "n_steps=64": "n_steps=8",
    '"async"': '"sync"',
}


_PYTHONS = ("python", "python3", ".venv/bin/python")
_SHELL = ("cd", "done", "git", "pytest", "source", "tar")


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
    for option, value in called[0].items():
        if isinstance(value, PairArguments):
            config = EvaluationConfig(**value.get_fields())
            # Other data sets define other setups.
            is_official = config.setup is not None and ":" not in config.dataset
            setup = config.setup if config.setup and is_official else "s0"
            scenes = list_split_scenes(setup, config.split, get_prescribed_side)
            if is_official and config.setup:
                choose_scenes(scenes, config.scenes, setup)
            for agent in ("giver", "receiver"):
                parse_policy(agent, getattr(config, agent))
        agent = option.removesuffix("s")
        if agent in ("giver", "receiver") and "my_package" not in str(value):
            for policy in (value,) if isinstance(value, str) else value or ():
                parse_policy(agent, policy)


def _check_script(path: Path, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that a script exists and accepts the arguments; skip one that needs a library that is not installed."""
    described = re.search(r"(?:tyro\.cli\(|run_script\(main, )(\w+)[,)]", path.read_text())
    assert described, f"{path.name} takes no arguments"
    try:
        module = import_file(path, monkeypatch)
    except ModuleNotFoundError as error:
        pytest.skip(str(error))
    try:
        tyro.cli(getattr(module, described[1]), args=arguments)
    except SystemExit as refusal:
        raise AssertionError(f"{path.name} {shlex.join(arguments)} is refused") from refusal


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_block_says_what_it_is(page: Path) -> None:
    assert {block.language.partition(" ")[0] for block in blocks(page)} <= LANGUAGES


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("block", SHELL)
def test_commands_are_taken(block: Block, monkeypatch: pytest.MonkeyPatch) -> None:
    found = list(commands(block.text))
    assert found
    for words in found:
        check(words, monkeypatch)


@pytest.mark.slow
def test_a_wrong_command_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in (
        "handover-marl benchmark --recever hold",
        "handover-marl benchmark --receiver nobody",
        "handover-marl benchmark --setup s0 --scenes 9",
        "handover-marl crossplay --givers nobody --receivers hold",
        "python experiments/make_results.py --scenes 37",
        "make everything",
        "pip install -e .[nothing]",
    ):
        with pytest.raises((AssertionError, HandoverError)):
            check(next(commands(text)), monkeypatch)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change to a folder with generated data; use one scene, few environments, short trainings and short checks."""
    monkeypatch.chdir(tmp_path)
    first, *_ = list_split_scenes("s3", "test", get_prescribed_side)
    write_layout(tmp_path / "handover" / "data", (FakeScene(first),))

    def one_scene(split: tuple[int, ...], scenes: Iterable[int] | None, split_label: str) -> tuple[int, ...]:
        return choose_scenes(split, scenes, split_label)[:1]

    monkeypatch.setattr("handover_marl.evaluation.config.choose_scenes", one_scene)
    for test, steps in ((testing.check_receiver, RECEIVER_STEPS), (testing.check_giver, GIVER_STEPS)):
        monkeypatch.setattr(testing, test.__name__, functools.partial(test, scenes=(9,), steps=steps))
    make_vec = gymnasium.make_vec
    monkeypatch.setattr(gymnasium, "make_vec", lambda name, _, **kwargs: make_vec(name, ENVIRONMENTS, **kwargs))
    if importlib.util.find_spec("stable_baselines3"):
        import stable_baselines3

        class ShortPPO(stable_baselines3.PPO):
            def learn(self, total_timesteps: int, *args: Any, **kwargs: Any) -> Any:
                return super().learn(DECISIONS, *args, **kwargs)

        short: Callable[..., Any] = functools.partial(ShortPPO, n_steps=DECISIONS, batch_size=DECISIONS)
        monkeypatch.setattr(stable_baselines3, "PPO", short)


def run(block: Block, names: dict[str, Any], smaller: dict[str, str]) -> None:
    """Run a block; a traceback shows the place in the page."""
    source = "\n" * (block.line - 1) + block.text
    for large, small in smaller.items():
        source = source.replace(large, small)
    place = f"{name(block.page)}:{block.line}"
    # The source code of policies is read when they are sent to other processes.
    linecache.cache[place] = (len(source), None, source.splitlines(keepends=True), place)
    exec(compile(source, place, "exec"), names)


@pytest.mark.slow
@pytest.mark.parametrize("page", PROGRAMS, ids=name)
@pytest.mark.filterwarnings("ignore")
def test_programs_run(page: Path, small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "".join(block.text for block in blocks(page, "python"))
    for module in {module for part, module in NEEDS.items() if part in text}:
        pytest.importorskip(module)
    shorten_episodes(monkeypatch, GIVER_STEPS if name(page) in WITH_GIVERS else EPISODE_STEPS)
    monkeypatch.setattr("handover_marl.learning.encodings.schemes.GraspServoScheme.wait", 0.2)
    names: dict[str, Any] = {"__name__": f"{page.stem}_blocks"}
    if page.stem == "demonstrations":
        handover_marl.demonstrate(
            setup="s0",
            receiver="yang2021:wait=0",
            physics="fast",
            obs_mode="state+pointcloud",
            out="runs/demos",
            progress=False,
            workers=1,
            fps=10,
        )
    try:
        for block in blocks(page, "python"):
            needed = [module for words, module in LOOPS.items() if words in block.text]
            if all(map(importlib.util.find_spec, needed)):
                run(block, names, SMALLER)
    finally:
        for value in names.values():
            if hasattr(value, "close") and not isinstance(value, type):
                value.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_receivers_take_the_bottle_of_the_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("coacd", "trimesh", "igl", "viser"):
        pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in blocks(OWN_OBJECT, "python"):
        run(block, names, {"range(20)": "range(4)", 'replays="all"': 'replays="all", scenes=(0,)'})
    assert names["scenes"].content.objects[0].n_grasps == 60
    assert names["report"].success_rate == 1.0, str(names["report"])
    assert len(list((tmp_path / "results" / "bottles" / "episodes").glob("*.html"))) == 1
