"""Functions and arguments that the speed measurements share."""

import multiprocessing
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import describe_machine
from handover_marl.simulation.engines import CPU


@dataclass(frozen=True)
class OutputArgs:
    """Arguments of scripts that print a report.

    Attributes:
        out: Markdown file to write; default: the report is only printed.
    """

    out: Path | None = None

    def publish(self, title: str, *parts: str) -> None:
        """Print the paragraphs of a report, and write them to the output file, if there is one."""
        text = "\n\n".join(parts)
        print(text)
        if self.out is not None:
            write_atomically(self.out, f"# {title}\n\n{text}\n")


def describe_conditions() -> str:
    """Return machine and date as text."""
    return f"{describe_machine()}, {date.today().isoformat()}"


def describe_device(device: str) -> str:
    """Return the name of a device, and state for the processor that the figures are not those of a GPU."""
    if device == CPU:
        return "Warp's CPU device, which is for tests; these are no figures of a GPU"
    import warp

    return str(warp.get_device(device).name)


def measure_peak_memory(function: Callable[..., Any], *arguments: Any) -> float:
    """Call a function in a new process and return the peak resident memory (MiB) of that process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        pool.apply(function, arguments)
        return pool.apply(read_memory, ("VmHWM:",))


def read_memory(name: str, file: str = "/proc/self/status") -> float:
    """Return a memory size (MiB) of a process from a file of Linux; 0 if the file lacks it.

    The peak of `getrusage` cannot be used, since a new process starts with the peak of its parent.

    Args:
        name: First word of the line with the size, such as "VmHWM:".
        file: File with lines of a name, a size (KiB) and "kB".
    """
    lines = Path(file).read_text().splitlines()
    return next((float(line.split()[1]) / 1024.0 for line in lines if line.startswith(name)), 0.0)
