"""Command-line program `handover-marl`."""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import tyro

from handover_marl import __version__
from handover_marl.cli.data_folders import run_doctor, run_import
from handover_marl.cli.folders import run_compare, run_evaluate, run_merge, run_verify
from handover_marl.cli.options import ArgumentError, registry
from handover_marl.cli.render import run_render
from handover_marl.cli.runs import run_agreement, run_benchmark, run_crossplay, run_demonstrate, run_pair
from handover_marl.errors import HandoverError

_DESCRIPTION = """Simulate and evaluate human-to-robot handovers.

Receivers: {receivers}.
Givers: {givers}.
A policy may also be your own class (my_package.robots:MyReceiver) and take options (omg:wait=1.5)."""

# In the order of the help text.
_COMMANDS: dict[str, Callable[..., int | None]] = {
    "benchmark": run_benchmark,
    "pair": run_pair,
    "agreement": run_agreement,
    "crossplay": run_crossplay,
    "demonstrate": run_demonstrate,
    "render": run_render,
    "evaluate": run_evaluate,
    "verify": run_verify,
    "compare": run_compare,
    "merge": run_merge,
    "import": run_import,
    "doctor": run_doctor,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command of the command line.

    Args:
        arguments: Command and options; default: those of this process.

    Returns:
        Exit status: 0 for success, 1 if `doctor` or `verify` found a fault, 2 after an error message, 130 after
        Ctrl-C, 141 if the reader of the output closed it.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if list(arguments) == ["--version"]:
        print(f"handover-marl {__version__}")
        return 0
    # The user's policies are imported from the working directory, as with `python -m`; it is
    # searched last, so that its modules do not hide installed ones.
    sys.path.append(str(Path.cwd()))
    from handover_marl.policies.registry import list_available

    names = {f"{agent}s": ", ".join(list_available(agent)) for agent in ("receiver", "giver")}
    app = tyro.extras.SubcommandApp()
    for name, run in _COMMANDS.items():
        app.command(name=name)(run)
    try:
        status: object = app.cli(
            prog="handover-marl",
            description=_DESCRIPTION.format(**names),
            args=arguments,
            registry=registry,
            config=(tyro.conf.OmitArgPrefixes,),
        )
        sys.stdout.flush()
    except (HandoverError, ArgumentError) as error:
        print(f"handover-marl: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("handover-marl: stopped; with --out, the same command resumes from here", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Python flushes stdout at exit, which must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return status if isinstance(status, int) else 0
