"""Command-line program `handover-marl`."""

import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from handover_marl.cli.streams import discard_output, prepare_streams, print_message
from handover_marl.errors import HandoverError
from handover_marl.version import __version__

# In a much narrower terminal, formatting a help text takes minutes, or never ends.
_MIN_COLUMNS = 40


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command of the command line.

    Args:
        arguments: Command and options; default: the command-line arguments of this process.

    Returns:
        Exit status: 0 for success, 1 if `doctor` or `verify` found a fault or `import` imported no scene, 2 after an
        error message, 130 after Ctrl-C, 141 if the reader of the output closed it.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    prepare_streams()
    try:
        if list(arguments) == ["--version"]:
            print(f"handover-marl {__version__}", flush=True)
            return 0
        if shutil.get_terminal_size().columns < _MIN_COLUMNS:
            os.environ["COLUMNS"] = str(_MIN_COLUMNS)
        # The user's policies are imported from the working directory, as with `python -m`; it is
        # searched last, so that its modules do not hide installed ones.
        sys.path.append(str(Path.cwd()))
        # Imported here, because the import takes a second, in which Ctrl-C may be pressed.
        from handover_marl.cli.program import run_program

        return run_program(arguments)
    except HandoverError as error:
        print_message(str(error))
        return 2
    except KeyboardInterrupt:
        print_message("stopped; with --out, the same command without --overwrite resumes from here")
        return 130
    except BrokenPipeError:
        discard_output()
        return 141
