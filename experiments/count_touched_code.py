"""Count the library code that one evaluation passes through.

    python experiments/count_touched_code.py
    python experiments/count_touched_code.py --list-names

The script counts code objects whose file belongs to the library (packages `handover_marl`, its givers,
receivers and assets):

- files: files with at least one executed function;
- classes: classes with at least one executed method that is written in their body (methods
  that `dataclass` generates are not counted);
- depth: the largest number of library frames on the call stack, recursive calls included.

Code that runs while modules are imported is not counted, nor are stack frames of other libraries.
The measured calls are `benchmark()` of one scene with `yang2021` in fast physics and one worker in this process;
one step of exact and one of MuJoCo physics after 500 steps; one decision of `vision`.
The script needs Python 3.11 or later and the extra `vision`.
"""

import functools
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from types import CodeType, FrameType
from typing import Any

import tyro

import handover_marl
import handover_marl.assets
import handover_marl.givers
import handover_marl.receivers
from handover_marl.datasets import open_dataset
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.evaluation.benchmark import benchmark
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig
from handover_marl.policies.reference import parse_policy

_PACKAGES = (handover_marl, handover_marl.givers, handover_marl.receivers, handover_marl.assets)
_ROOTS = tuple(os.path.dirname(str(package.__file__)) + os.sep for package in _PACKAGES)  # noqa: PTH120
_MEASURED_STEP = 500
_SCENE = 209


@dataclass
class TouchedCode:
    """Library code that was executed while a `Profiler` was active.

    Attributes:
        files: Paths of the library's files with at least one executed function.
        classes: Pairs of file and class name of the classes with at least one executed method.
        deepest: Names of the library functions on the deepest call stack, outermost first.
    """

    files: set[str] = field(default_factory=set)
    classes: set[tuple[str, str]] = field(default_factory=set)
    deepest: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{len(self.files)} files, {len(self.classes)} classes, depth {len(self.deepest)}"


class Profiler:
    """Recorder of executed library functions, for use in a `with` statement.

    Attributes:
        touched: Library code executed so far.
    """

    def __init__(self) -> None:
        self.touched = TouchedCode()
        self._stack: list[CodeType] = []
        self._n_imports = 0

    def __enter__(self) -> TouchedCode:
        sys.setprofile(self._profile)
        return self.touched

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)

    def _profile(self, frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if code.co_name == "<module>":
            self._n_imports += {"call": 1, "return": -1}.get(event, 0)
        elif self._n_imports or not code.co_filename.startswith(_ROOTS):
            return
        elif event == "call":
            self._stack.append(code)
            self._record(code)
        elif event == "return" and self._stack and self._stack[-1] is code:
            self._stack.pop()

    def _record(self, code: CodeType) -> None:
        self.touched.files.add(code.co_filename)
        owner = get_class_name(code)
        if owner:
            self.touched.classes.add((code.co_filename, owner))
        if len(self._stack) > len(self.touched.deepest):
            self.touched.deepest = [get_qualified_name(part) for part in self._stack]


def get_qualified_name(code: CodeType) -> str:
    """Return the name of a code object with those of its class and of the functions around it."""
    return str(code.co_qualname)  # type: ignore[attr-defined]  # Python 3.10, for which types are checked, lacks it


def get_class_name(code: CodeType) -> str:
    """Return the name of the class whose method a code object is; empty for other functions."""
    names = get_qualified_name(code).split(".")
    owners = [name for name in names[:-1] if name.lstrip("_")[:1].isupper()]
    return owners[-1] if owners else ""


def count_benchmark(data_dir: str | None) -> TouchedCode:
    """Return the library code that `benchmark()` executes for one scene.

    Args:
        data_dir: Folder in HandoverSim's layout; default: a synthetic scene is simulated.
    """
    dataset = "synthetic" if data_dir is None else "dexycb"
    config = EvaluationConfig(scenes=(_SCENE,), receiver="yang2021", dataset=dataset, data_dir=data_dir, physics="fast")
    with Profiler() as touched:
        benchmark(config, execution=ExecutionConfig(workers=1, progress=False))
    return touched


class _StepProfiler(EpisodeCallback):
    """Callback that profiles one physics step in the middle of an episode."""

    def __init__(self) -> None:
        self.profiler = Profiler()

    def on_step(self, episode: Episode) -> None:
        if episode.steps == _MEASURED_STEP:
            self.profiler.__enter__()
        elif episode.steps == _MEASURED_STEP + 1:
            self.profiler.__exit__()


def count_step(physics: str) -> TouchedCode:
    """Return the library code that one physics step executes, including contacts and referee.

    Args:
        physics: Physics engine: exact, fast or mujoco.
    """
    dataset = open_dataset("synthetic")
    episode, profiler = Episode(physics), _StepProfiler()
    receiver = parse_policy("receiver", "yang2021").resolve(dataset).make(dataset)
    episode.reset(dataset.load_scene(_SCENE))
    run_episode(episode, receiver, seed=0, until=_MEASURED_STEP + 10, callbacks=[profiler])
    episode.close()
    return profiler.profiler.touched


def count_decision() -> TouchedCode:
    """Return the library code executed by one `act` of `vision` after it detected the object."""
    dataset = open_dataset("synthetic", robot="panda_camera")
    episode, profiler = Episode("fast"), Profiler()
    receiver = parse_policy("receiver", "vision").resolve(dataset).make(dataset)
    act, n_calls = receiver.act, 0

    @functools.wraps(act)
    def act_profiled(observation: Any) -> Any:
        nonlocal n_calls
        n_calls += 1
        if n_calls != 10:
            return act(observation)
        with profiler:
            return act(observation)

    receiver.act = act_profiled  # type: ignore[method-assign]
    episode.reset(dataset.load_scene(_SCENE))
    run_episode(episode, receiver, seed=0, until=lambda: n_calls >= 10)
    episode.close()
    return profiler.touched


def main(list_names: bool = False, data_dir: str | None = None) -> None:
    """Print the counts of files, classes and depth for each measured call.

    Args:
        data_dir: Folder in HandoverSim's layout for the scene of `benchmark()`; default: a
            synthetic scene.
        list_names: Whether to print the names of files, classes and functions too.
    """
    counts: dict[str, Callable[[], TouchedCode]] = {
        "one scene through benchmark()": functools.partial(count_benchmark, data_dir),
        "one exact physics step": functools.partial(count_step, "exact"),
        "one fast physics step": functools.partial(count_step, "fast"),
        "one MuJoCo physics step": functools.partial(count_step, "mujoco"),
        "one decision of vision": count_decision,
    }
    for name, count in counts.items():
        touched = count()
        print(f"{name}: {touched}")
        if list_names:
            root = os.path.dirname(_ROOTS[0].rstrip(os.sep)) + os.sep  # noqa: PTH120
            print(*sorted(f"  {path.removeprefix(root)}" for path in touched.files), sep="\n")
            print(*sorted(f"  class {owner}" for _, owner in touched.classes), sep="\n")
            print(*(f"  > {function}" for function in touched.deepest), sep="\n")


if __name__ == "__main__":
    tyro.cli(main)
