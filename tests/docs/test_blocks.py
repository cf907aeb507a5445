"""Tests of all code blocks of the documentation, on a few short synthetic scenes or on generated data."""

import functools
import importlib.util
import linecache
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import gymnasium
import pytest

import handover_marl
from handover_marl import testing
from handover_marl.datasets.splits import choose_scenes, get_prescribed_side, list_split_scenes
from handover_marl.errors import HandoverError
from tests.docs.commands import check, commands
from tests.docs.pages import PAGES, Block, blocks, inline_commands, name
from tests.fake_layout import FakeScene, write_layout
from tests.short_episodes import shorten_episodes

LANGUAGES = {"python", "bash", "ini", "text", "bibtex", "{include}", "{toctree}", "{eval-rst}"}
SHELL = [
    pytest.param(block, id=f"{name(page)}:{block.line}")
    for page in PAGES
    for block in (*blocks(page, "bash"), *inline_commands(page))
]
#: Pages with programs. The programs of own_object.md take long; test_own_object runs them and checks their results.
PROGRAMS = [page for page in PAGES if blocks(page, "python") and page.stem != "own_object"]
#: Additional modules that the programs of a page need, by page.
NEEDS = {"docs/how_to/wrist_camera.md": ("embreex",)} | {
    "README.md": ("viser",),
    "docs/how_to/demonstrations.md": ("embreex",),
    "docs/how_to/many_machines.md": ("ray",),
    "docs/how_to/gpu.md": ("mujoco_warp", "embreex"),
    "docs/how_to/vector_environments.md": ("mujoco", "stable_baselines3", "torchrl"),
    "docs/reference/rewards.md": ("mujoco", "stable_baselines3"),
    "docs/tutorials/own_receiver.md": ("stable_baselines3",),
    "docs/tutorials/training.md": ("mujoco", "stable_baselines3"),
}
#: Additional module that a script needs, by the beginning of its name.
SCRIPTS_NEED = {
    "train": "torch",
    "train_receiver": "stable_baselines3",
    "train_giver": "stable_baselines3",
    "train_with_population": "stable_baselines3",
    "other_libraries/train_both_torchrl": "torchrl",
    "other_libraries/train_both_rllib": "tree",  # a requirement of RLlib; the backend needs only Ray
    "other_libraries/train_both_benchmarl": "benchmarl",
    "other_libraries/train_both_tianshou": "tianshou",
}
ENVIRONMENTS, DECISIONS = 2, 16
#: Pages whose programs need what happens late in an episode: a decision of the giver, a release, or a success.
WHOLE_EPISODES = ("docs/tutorials/own_giver.md", "docs/how_to/demonstrations.md", "docs/reference/rewards.md")
#: Physics steps (1 ms) of the episodes of other pages, and of the conformance tests of receivers and givers; learned
#: receivers wait 2 s.
EPISODE_STEPS, RECEIVER_STEPS, GIVER_STEPS = 2500, 2500, 4000
CHECKED_SCENES = (9,)
#: Parts of the programs of a page, and what the test runs instead of them, so that less is simulated.
SMALLER = {
    "docs/how_to/demonstrations.md": {"episode.steps[:-1]": "episode.steps[:4]"},
    "docs/how_to/vector_environments.md": {"64": str(ENVIRONMENTS)},
    "docs/tutorials/training.md": {"64": str(ENVIRONMENTS)},
    "docs/how_to/many_machines.md": {'backend="ray"': 'backend="ray", workers=1'},
    # Kernels of MuJoCo Warp for three environments are compiled for other tests, too.
    "docs/how_to/gpu.md": {"    8,": "    3,", "vector_env(4,": "vector_env(3,"},
}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_block_says_what_it_is(page: Path) -> None:
    assert {block.language.partition(" ")[0] for block in blocks(page)} <= LANGUAGES


@pytest.mark.slow
@pytest.mark.parametrize("block", SHELL)
def test_commands_are_taken(block: Block, monkeypatch: pytest.MonkeyPatch) -> None:
    found = list(commands(block.text))
    assert found
    for words in found:
        for script, module in SCRIPTS_NEED.items():
            if f"experiments/training/{script}" in " ".join(words):
                pytest.importorskip(module)
        check(words, monkeypatch)


def test_a_wrong_command_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in (
        "handover-marl benchmark --recever hold",
        "handover-marl benchmark --receiver nobody",
        "handover-marl crossplay --givers nobody --receivers hold",
        "python experiments/rank_correlation.py --scenes 37",
        "make everything",
        "pip install -e .[nothing]",
    ):
        with pytest.raises((AssertionError, HandoverError)):
            check(next(commands(text)), monkeypatch)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change to a folder with generated data; use one scene, few environments, short trainings and short checks."""
    monkeypatch.chdir(tmp_path)
    # Otherwise Ray would join a cluster of another test on this machine, and fail when that cluster ends.
    monkeypatch.setenv("RAY_ADDRESS", "local")
    first, *_ = list_split_scenes("s3", "test", get_prescribed_side)
    write_layout(tmp_path / "handover" / "data", (FakeScene(first),))

    def one_scene(split: tuple[int, ...], scenes: Iterable[int] | None, where: str) -> tuple[int, ...]:
        return choose_scenes(split, scenes, where)[:1]

    monkeypatch.setattr("handover_marl.evaluation.config.choose_scenes", one_scene)
    for test, steps in ((testing.check_receiver, RECEIVER_STEPS), (testing.check_giver, GIVER_STEPS)):
        monkeypatch.setattr(testing, test.__name__, functools.partial(test, scenes=CHECKED_SCENES, steps=steps))
    make_vec = gymnasium.make_vec
    monkeypatch.setattr(gymnasium, "make_vec", lambda name, _, **kwargs: make_vec(name, ENVIRONMENTS, **kwargs))
    if importlib.util.find_spec("stable_baselines3"):
        import stable_baselines3

        class ShortPPO(stable_baselines3.PPO):
            def learn(self, total_timesteps: int, *args: Any, **kwargs: Any) -> Any:
                return super().learn(DECISIONS, *args, **kwargs)

        short: Callable[..., Any] = functools.partial(ShortPPO, n_steps=DECISIONS, batch_size=DECISIONS)
        monkeypatch.setattr(stable_baselines3, "PPO", short)


def run(block: Block, names: dict[str, Any]) -> None:
    """Run a block and the tests that it defines; a traceback shows the place in the page."""
    source = "\n" * (block.line - 1) + block.text
    for large, small in SMALLER.get(name(block.page), {}).items():
        source = source.replace(large, small)
    place = f"{name(block.page)}:{block.line}"
    # The source code of policies is read when they are sent to other processes.
    linecache.cache[place] = (len(source), None, source.splitlines(keepends=True), place)
    before = set(names)
    exec(compile(source, place, "exec"), names)
    for added in sorted(set(names) - before):
        if added.startswith("test_"):
            names[added]()


@pytest.mark.slow
@pytest.mark.parametrize("page", PROGRAMS, ids=name)
@pytest.mark.filterwarnings("ignore")
def test_programs_run(page: Path, small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in NEEDS.get(name(page), ()):
        pytest.importorskip(module)
    if name(page) not in WHOLE_EPISODES:
        shorten_episodes(monkeypatch, EPISODE_STEPS)
    names: dict[str, Any] = {"__name__": f"{page.stem}_blocks"}
    if page.stem == "demonstrations":
        handover_marl.demonstrate(
            setup="s0", receiver="yang2021", physics="fast", obs_mode="state+pointcloud", out="DIR", progress=False
        )
    try:
        for block in blocks(page, "python"):
            run(block, names)
    finally:
        for value in names.values():
            if hasattr(value, "close") and not isinstance(value, type):
                value.close()
        if name(page) == "docs/how_to/many_machines.md":
            import ray

            ray.shutdown()
