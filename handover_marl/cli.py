"""The command line, `handover-marl`: a command for everything that can be done without writing code."""

import os
import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from docstring_parser import parse
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from handover_marl._version import __version__
from handover_marl.errors import HandoverError, OptionError
from handover_marl.files import write_atomically
from handover_marl.run import OF_SEVERAL, Execution, Run

if TYPE_CHECKING:
    from handover_marl.config import CameraConfig

_DESCRIPTION = """Human-to-robot handovers.

Receivers: {receivers}.
Givers: {givers}.
A policy may also be a class of yours (my_package.robots:MyReceiver) and take options (omg:wait=1.5)."""

app = tyro.extras.SubcommandApp()
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
# Fields of a run that also one scene has.
_OF_A_SCENE = ("dataset", "data_dir", "physics", "robot", "renderer", "geometry", "imperfections", "seed", "giver")
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


class _ToldError(Exception):
    """What tyro is not to tell in its own way."""


def _make_run(**told: Any) -> Run:
    try:
        scenes = parse_scenes(told.pop("scenes", None))
    except OptionError as error:
        raise _ToldError(str(error)) from error
    return Run(scenes=None if scenes is None else tuple(scenes), **told)


_OFFICIAL, _CROSSPLAY = BenchmarkRun(), CrossPlayRun(split="val")
_SCENE, _SHOWN = SceneRun(), SceneExecution()
_Page = Annotated[str | None, tyro.conf.arg(metavar="FILE.html")]
_Names = Annotated[str, tyro.conf.arg(metavar="POLICY,...")]


@app.command(name="benchmark")
def run_benchmark(run: BenchmarkRun = _OFFICIAL, how: Execution = Execution()) -> None:
    """Run HandoverSim's official protocol and print its table.

    Args:
        run: What is run.
        how: How it is run; outcomes do not depend on it.
    """
    from handover_marl.benchmarking.runner import benchmark

    print(benchmark(run, execution=_expanded(how)))


@app.command(name="pair")
def run_pair(run: Run = Run(split="val"), how: Execution = Execution()) -> None:
    """Let any giver and any receiver play the scenes of a split and print the table.

    Args:
        run: What is run.
        how: How it is run; outcomes do not depend on it.
    """
    from handover_marl.benchmarking.runner import evaluate_run

    print(evaluate_run(run, _expanded(how)))


@app.command(name="agreement")
def run_agreement(run: Run = Run(split="val"), against: str = "fast", how: Execution = Execution()) -> None:
    """Play the same scenes in exact and in fast or MuJoCo's physics and compare the outcomes.

    Args:
        run: What is run; its physics do not count.
        against: What exact physics are compared with, fast or mujoco.
        how: How it is run; outcomes do not depend on it.
    """
    from handover_marl.benchmarking.agreement import agreement

    print(agreement(run, against=against, execution=_expanded(how)))


@app.command(name="crossplay")
def run_crossplay(
    givers: _Names = "replay,cooperative,hesitant",
    receivers: _Names = "hold,yang2021",
    run: CrossPlayRun = _CROSSPLAY,
    how: Execution = Execution(),
) -> None:
    """Play every giver with every receiver and print who gets on with whom.

    Args:
        givers: Givers, with commas; gains are told over the first one.
        receivers: Receivers, with commas.
        run: What is run.
        how: How it is run; outcomes do not depend on it.
    """
    from handover_marl.benchmarking.crossplay import crossplay
    from handover_marl.policies.reference import split_names

    rows, columns = split_names("giver", givers), split_names("receiver", receivers)
    print(crossplay(rows, columns, run, execution=_expanded(how)))


@app.command(name="demonstrate")
def run_demonstrate(
    sight: Literal["none", "points", "clouds", "images"] = "none",
    observe: Literal["all", "sight"] = "all",
    keep: Literal["all", "success"] = "all",
    run: Run = Run(split="train", receiver="reactive"),
    how: Execution = Execution(),
) -> None:
    """Record episodes of a train split as a data set in Minari's layout (--out DIR).

    Args:
        sight: What is recorded of the wrist camera, whatever the receiver itself looks at.
        observe: all, or sight: proprioception and sight alone.
        keep: all episodes, with their outcome, or only successes.
        run: What is run.
        how: How it is run; the data do not depend on it.
    """
    from handover_marl.demonstrations.demonstrate import demonstrate

    shown = None if sight == "none" else sight
    print(demonstrate(run, sight=shown, observe=observe, keep=keep, execution=_expanded(how)))


@app.command(name="render")
def run_render(
    scene: int,
    out: Annotated[str, tyro.conf.arg(metavar="FILE")],
    receiver: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None,
    plan: bool = False,
    view: Literal["outside", "wrist"] = "outside",
    key_frames: int = 6,
    width: int | None = None,
    height: int | None = None,
    run: SceneRun = _SCENE,
    how: SceneExecution = _SHOWN,
) -> None:
    """Draw a scene, the episode that policies make of it, or what a receiver plans.

    Args:
        scene: Number of the scene, 0 to 999.
        out: A .png is a sheet of key frames; .gif and .mp4 are films; an .html plays the episode in three dimensions.
        receiver: The robot's policy; without one the robot stays at rest.
        plan: Draw the plan of a receiver such as omg (.png): start, goals, the chosen one, the hand's path.
        view: outside, or wrist: the same beside depth, segmentation and cloud of the robot's wrist camera.
        key_frames: Pictures on a sheet.
        width: Width of a picture in pixels.
        height: Height of a picture in pixels.
        run: What is shown.
        how: How.
    """
    from handover_marl.config import CameraConfig
    from handover_marl.pictures.rendering import render_scene

    told: Any = {key: getattr(run, key) for key in _OF_A_SCENE}
    told |= {"trust": how.trust}
    if plan:
        from handover_marl.pictures.plan_picture import PLAN_CAMERA, render_plan

        seen_from = _sized(PLAN_CAMERA, width, height)
        print(render_plan(scene, out, receiver=receiver or "omg", camera=seen_from, **told))
        return
    # Otherwise each kind of file is seen from where it looks best.
    camera = None if width is None and height is None else _sized(CameraConfig(), width, height)
    told |= {"progress": how.progress}
    print(render_scene(scene, out, receiver=receiver, key_frames=key_frames, camera=camera, view=view, **told))


def _sized(camera: "CameraConfig", width: int | None, height: int | None) -> "CameraConfig":
    wide = camera.width if width is None else width
    return replace(camera, width=wide, height=camera.height if height is None else height)


@app.command(name="evaluate")
def run_evaluate(folder: Annotated[str, tyro.conf.arg(metavar="DIR")], /, out: _Page = None) -> None:
    """Print the table of an official result folder, ours or the original authors'.

    Args:
        folder: The result folder (config.yaml and 000.npz, 001.npz, ...).
        out: An .html file for the report as a page, too.
    """
    from handover_marl.benchmarking.evaluation import evaluate

    path = _page_path(out)
    report = evaluate(folder)
    print(report)
    if path is not None:
        from handover_marl.benchmarking.report_page import replay_links, report_page

        write_atomically(path, report_page(report, replay_links(Path(folder).expanduser(), path.parent)))


@app.command(name="compare")
def run_compare(
    first: Annotated[str, tyro.conf.arg(metavar="DIR")],
    second: Annotated[str, tyro.conf.arg(metavar="DIR")],
    /,
    out: _Page = None,
) -> None:
    """Compare two result folders scene by scene, without playing anything.

    Args:
        first: A result folder.
        second: Another one, of the same setup, split and data.
        out: An .html file for the comparison as a page, too.
    """
    from handover_marl.benchmarking.comparison import compare

    path = _page_path(out)
    comparison = compare(first, second)
    print(comparison)
    if path is not None:
        from handover_marl.benchmarking.report_page import comparison_page, replay_links

        one, other = (replay_links(Path(side).expanduser(), path.parent) for side in (first, second))
        write_atomically(path, comparison_page(comparison, (one, other)))


@app.command(name="merge")
def run_merge(
    folders: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DIR"), tyro.conf.Positional],
    out: Annotated[str, tyro.conf.arg(metavar="DIR")],
) -> None:
    """Make one folder of the folders of all shards of a run (--shard), and print what the run would have printed.

    Args:
        folders: The folders of the shards, in any order.
        out: The folder to make: as the run would have written it.
    """
    from handover_marl.merging.merge import merge

    print(merge(folders, out))


def _page_path(out: str | None) -> Path | None:
    if out is None:
        return None
    from handover_marl.pictures.rendering import checked_path

    return checked_path(out, (".html",))


@app.command(name="import")
def run_import(
    dexycb: Annotated[str, tyro.conf.arg(metavar="DIR")],
    mano: Annotated[str, tyro.conf.arg(metavar="DIR")],
    out: Annotated[str, tyro.conf.arg(metavar="DIR")],
    third_party: Annotated[str | None, tyro.conf.arg(metavar="DIR|ARCHIVE")] = None,
    scenes: Annotated[str | None, tyro.conf.arg(metavar="N,N,...")] = None,
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    progress: bool = True,
) -> None:
    """Make HandoverSim's data folder from raw DexYCB, MANO and HandoverSim's third-party archive.

    Args:
        dexycb: The folder that DexYCB's archives were expanded into.
        mano: The folder with MANO_RIGHT.pkl and MANO_LEFT.pkl.
        out: The data folder to make, or to go on with.
        third_party: HandoverSim's assets-3rd-party archive, or the folder that it was unpacked into; without it,
            DexYCB's models, convex parts made of them, the library's grasps and PyBullet's Panda stand in.
        scenes: Only these scenes, e.g. 209,214.
        workers: Processes; default: one a core.
        progress: Show a progress bar on stderr.
    """
    from handover_marl.datasets.importing.import_dexycb import import_dexycb

    chosen = parse_scenes(scenes)
    print(import_dexycb(dexycb, mano, out, third_party=third_party, scenes=chosen, workers=workers, progress=progress))


@app.command(name="doctor")
def run_doctor(
    data_dir: Annotated[str | None, tyro.conf.arg(metavar="DIR")] = None,
    progress: bool = True,
) -> int:
    """Look what is installed and what of a data folder is there, and tell what to do about what is not.

    The exit status is 0 if nothing is wrong, 1 if something is. Notes, such as a hand that stands in for MANO's, are
    not wrong.

    Args:
        data_dir: A folder in HandoverSim's layout; default: the one that HANDOVER_MARL_DATA names, if any.
        progress: Show a progress bar on stderr.
    """
    from handover_marl.datasets import DATA_VARIABLE
    from handover_marl.doctor.data_folder import examine
    from handover_marl.doctor.findings import State, findings_text
    from handover_marl.doctor.installation import examine_installation

    findings = list(examine_installation())
    chosen = data_dir or os.environ.get(DATA_VARIABLE)
    if chosen:
        findings += examine(Path(chosen).expanduser(), progress)
    print(findings_text(findings))
    if not chosen:
        print(f"\nNo data folder (--data-dir or {DATA_VARIABLE}): everything runs on the synthetic scenes.")
    return int(any(finding.state is State.FAULT for finding in findings))


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


def _expanded(how: Execution) -> Execution:
    return how if how.out is None else replace(how, out=os.path.expanduser(how.out))  # noqa: PTH111  (stays text)


def _description() -> str:
    from handover_marl.policies.registry import available

    return _DESCRIPTION.format(receivers=", ".join(available("receiver")), givers=", ".join(available("giver")))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; errors a user can mend come as one message and exit status 2, Ctrl-C as 130.

    `doctor` tells by status 1 that it found something.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if list(arguments) == ["--version"]:
        print(f"handover-marl {__version__}")
        return 0
    # Policies of one's own are found where one stands, like with `python -m`, but shadow nothing that is installed.
    sys.path.append(str(Path.cwd()))
    try:
        status: object = app.cli(
            prog="handover-marl",
            description=_description(),
            args=arguments,
            registry=registry,
            config=(tyro.conf.OmitArgPrefixes,),
        )
        sys.stdout.flush()
    except (HandoverError, _ToldError) as error:
        print(f"handover-marl: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("handover-marl: stopped; with --out, the same command goes on from here", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Who reads our output has seen enough; nothing more may be written to it at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return status if isinstance(status, int) else 0


if __name__ == "__main__":
    sys.exit(main())
