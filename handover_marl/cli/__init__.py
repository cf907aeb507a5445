"""The command line, `handover-marl`: a command for everything that can be done without writing code."""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import tyro

from handover_marl._version import __version__
from handover_marl.cli.data_folders import run_doctor, run_import
from handover_marl.cli.folders import run_compare, run_evaluate, run_merge
from handover_marl.cli.run_options import ToldError, registry
from handover_marl.cli.runs import run_agreement, run_benchmark, run_crossplay, run_demonstrate, run_pair
from handover_marl.cli.showing import run_render
from handover_marl.errors import HandoverError

_DESCRIPTION = """Human-to-robot handovers.

Receivers: {receivers}.
Givers: {givers}.
A policy may also be a class of yours (my_package.robots:MyReceiver) and take options (omg:wait=1.5)."""

# In the order in which the help lists them.
_COMMANDS: dict[str, Callable[..., int | None]] = {
    "benchmark": run_benchmark,
    "pair": run_pair,
    "agreement": run_agreement,
    "crossplay": run_crossplay,
    "demonstrate": run_demonstrate,
    "render": run_render,
    "evaluate": run_evaluate,
    "compare": run_compare,
    "merge": run_merge,
    "import": run_import,
    "doctor": run_doctor,
}


def _app() -> tyro.extras.SubcommandApp:
    app = tyro.extras.SubcommandApp()
    for name, run in _COMMANDS.items():
        app.command(name=name)(run)
    return app


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
        status: object = _app().cli(
            prog="handover-marl",
            description=_description(),
            args=arguments,
            registry=registry,
            config=(tyro.conf.OmitArgPrefixes,),
        )
        sys.stdout.flush()
    except (HandoverError, ToldError) as error:
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
