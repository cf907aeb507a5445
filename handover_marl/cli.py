"""The command line: handover-marl benchmark | evaluate."""

import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from handover_marl.errors import HandoverError, OptionError

_Scenes = Annotated[str | None, tyro.conf.arg(metavar="N,N,...")]
_Folder = Annotated[str | None, tyro.conf.arg(metavar="DIR")]

app = tyro.extras.SubcommandApp()


@app.command(name="benchmark")
def run_benchmark(
    setup: str = "s0",
    split: str = "test",
    receiver: str = "yang2021",
    scenes: _Scenes = None,
    data_dir: _Folder = None,
    out: _Folder = None,
) -> None:
    """Run HandoverSim's official protocol and print its table.

    Args:
        setup: Official setup: s0 seen, s1 unseen subjects, s2 unseen handedness, s3 unseen objects.
        split: train, val or test.
        receiver: Name of the receiver, e.g. yang2021 or hold.
        scenes: Only these scenes, e.g. 209,214.
        data_dir: Folder in HandoverSim's layout; default: the variable HANDOVER_MARL_DATA.
        out: Folder for official result files and reports; an interrupted run goes on there.
    """
    from handover_marl.benchmarking.runner import benchmark

    report = benchmark(setup, split, receiver, scenes=parse_scenes(scenes), data_dir=data_dir, out=out)
    print(report)


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
    try:
        app.cli(prog="handover-marl", description="Human-to-robot handovers.", args=arguments)
    except HandoverError as error:
        print(f"handover-marl: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("handover-marl: stopped; with --out, the same command goes on from here", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
