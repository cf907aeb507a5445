"""The command line: handover-marl benchmark | agreement | crossplay | evaluate | render."""

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import tyro

from handover_marl._version import __version__
from handover_marl.errors import HandoverError, OptionError

if TYPE_CHECKING:
    from handover_marl.config import CameraConfig

_Scenes = Annotated[str | None, tyro.conf.arg(metavar="N,N,...")]
_Names = Annotated[str, tyro.conf.arg(metavar="NAME,NAME,...")]
_Workers = Annotated[int | None, tyro.conf.arg(metavar="N")]
_Folder = Annotated[str | None, tyro.conf.arg(metavar="DIR")]

app = tyro.extras.SubcommandApp()


@app.command(name="benchmark")
def run_benchmark(
    setup: str = "s0",
    split: str = "test",
    receiver: str = "yang2021",
    scenes: _Scenes = None,
    data_dir: _Folder = None,
    dataset: str = "auto",
    physics: str = "exact",
    out: _Folder = None,
    workers: _Workers = None,
    trust: bool = False,
) -> None:
    """Run HandoverSim's official protocol and print its table.

    Args:
        setup: Official setup: s0 seen, s1 unseen subjects, s2 unseen handedness, s3 unseen objects.
        split: train, val or test.
        receiver: Name of the receiver, e.g. yang2021, hold, or learned:FILE.
        scenes: Only these scenes, e.g. 209,214.
        data_dir: Folder in HandoverSim's layout; default: the variable HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto: dexycb when there is a data folder, else synthetic.
        physics: exact, as official results are, or fast.
        out: Folder for official result files and reports; an interrupted run goes on there.
        workers: Processes to play scenes in; default: one a core. Outcomes do not depend on it.
        trust: Let code in a policy file (learned:FILE) run.
    """
    from handover_marl.benchmarking.runner import benchmark

    report = benchmark(
        setup,
        split,
        receiver,
        scenes=parse_scenes(scenes),
        data_dir=data_dir,
        dataset=dataset,
        physics=physics,
        out=out,
        workers=workers,
        trust=trust,
    )
    print(report)


@app.command(name="agreement")
def run_agreement(
    setup: str = "s0",
    split: str = "val",
    receiver: str = "yang2021",
    scenes: _Scenes = None,
    data_dir: _Folder = None,
    dataset: str = "auto",
    out: _Folder = None,
    workers: _Workers = None,
) -> None:
    """Play the same scenes in exact and in fast physics and compare the outcomes.

    Args:
        setup: Official setup: s0 seen, s1 unseen subjects, s2 unseen handedness, s3 unseen objects.
        split: train, val or test.
        receiver: Name of the receiver, e.g. yang2021 or hold.
        scenes: Only these scenes, e.g. 209,214.
        data_dir: Folder in HandoverSim's layout; default: the variable HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto: dexycb when there is a data folder, else synthetic.
        out: Folder for both results and the comparison; an interrupted run goes on there.
        workers: Processes to play scenes in; default: one a core.
    """
    from handover_marl.benchmarking.agreement import agreement

    print(
        agreement(
            setup,
            split,
            receiver,
            scenes=parse_scenes(scenes),
            data_dir=data_dir,
            dataset=dataset,
            out=out,
            workers=workers,
        )
    )


@app.command(name="crossplay")
def run_crossplay(
    givers: _Names = "replay,cooperative,hesitant",
    receivers: _Names = "hold,yang2021",
    setup: str = "s0",
    split: str = "val",
    scenes: _Scenes = None,
    data_dir: _Folder = None,
    dataset: str = "auto",
    physics: str = "exact",
    out: _Folder = None,
    workers: _Workers = None,
    trust: bool = False,
) -> None:
    """Play every giver with every receiver and print who gets on with whom.

    Args:
        givers: Names of givers, or learned:FILE; gains are told over the first one.
        receivers: Names of receivers, or learned:FILE.
        setup: Official setup: s0 seen, s1 unseen subjects, s2 unseen handedness, s3 unseen objects.
        split: train, val or test.
        scenes: Only these scenes, e.g. 209,214.
        data_dir: Folder in HandoverSim's layout; default: the variable HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto: dexycb when there is a data folder, else synthetic.
        physics: exact or fast.
        out: Folder for all results, the tables and a picture; an interrupted run goes on there.
        workers: Processes to play scenes in; default: one a core.
        trust: Let code in policy files (learned:FILE) run.
    """
    from handover_marl.benchmarking.crossplay import crossplay

    print(
        crossplay(
            [name.strip() for name in givers.split(",")],
            [name.strip() for name in receivers.split(",")],
            setup,
            split,
            scenes=parse_scenes(scenes),
            data_dir=data_dir,
            dataset=dataset,
            physics=physics,
            out=out,
            workers=workers,
            trust=trust,
        )
    )


@app.command(name="render")
def run_render(
    scene: int,
    out: Annotated[str, tyro.conf.arg(metavar="FILE")],
    dataset: str = "auto",
    data_dir: _Folder = None,
    receiver: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    physics: str = "exact",
    plan: bool = False,
    key_frames: int = 6,
    width: int | None = None,
    height: int | None = None,
) -> None:
    """Draw a scene, the episode that a receiver makes of it, or what a receiver plans.

    Args:
        scene: Number of the scene, 0 to 999.
        out: A .png is a sheet of key frames; .gif and .mp4 are films.
        dataset: dexycb, synthetic, or auto: dexycb when there is a data folder, else synthetic.
        data_dir: Folder in HandoverSim's layout; default: the variable HANDOVER_MARL_DATA.
        receiver: Name of a receiver; without one the robot stays at rest.
        physics: exact or fast.
        plan: Draw the plan of a receiver such as omg (.png): start, goals, the chosen one, the hand's path.
        key_frames: Pictures on a sheet.
        width: Width of a picture in pixels.
        height: Height of a picture in pixels.
    """
    from handover_marl.config import CameraConfig
    from handover_marl.rendering import render_scene

    if plan:
        from handover_marl.plan_picture import PLAN_CAMERA, render_plan

        print(
            render_plan(
                scene,
                out,
                receiver=receiver or "omg",
                dataset=dataset,
                data_dir=data_dir,
                physics=physics,
                camera=_sized(PLAN_CAMERA, width, height),
            )
        )
        return
    path = render_scene(
        scene,
        out,
        dataset=dataset,
        data_dir=data_dir,
        receiver=receiver,
        physics=physics,
        key_frames=key_frames,
        camera=_sized(CameraConfig(), width, height),
    )
    print(path)


def _sized(camera: "CameraConfig", width: int | None, height: int | None) -> "CameraConfig":
    wide = camera.width if width is None else width
    return replace(camera, width=wide, height=camera.height if height is None else height)


@app.command(name="evaluate")
def run_evaluate(folder: Annotated[str, tyro.conf.arg(metavar="DIR")], /) -> None:
    """Print the table of an official result folder, ours or the original authors'.

    Args:
        folder: The result folder (config.yaml and 000.npz, 001.npz, ...).
    """
    from handover_marl.benchmarking.evaluation import evaluate

    print(evaluate(folder))


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
        raise OptionError(
            f"--scenes takes scene numbers separated by commas, such as 209,214, not {text!r}"
        ) from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; errors a user can mend come as one message and exit status 2, Ctrl-C as 130."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if list(arguments) == ["--version"]:
        print(f"handover-marl {__version__}")
        return 0
    try:
        app.cli(prog="handover-marl", description="Human-to-robot handovers.", args=arguments)
        sys.stdout.flush()
    except HandoverError as error:
        print(f"handover-marl: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("handover-marl: stopped; with --out, the same command goes on from here", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Who reads our output has seen enough; nothing more may be written to it at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return 0


if __name__ == "__main__":
    sys.exit(main())
