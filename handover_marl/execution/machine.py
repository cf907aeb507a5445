"""Description of the machine that runs the program, stored beside measured times."""

import os
import platform
from pathlib import Path


def describe_machine() -> str:
    """Return this machine's processor, number of cores and version of Python as text."""
    return f"{_read_processor_name()}, {os.cpu_count()} cores, Python {platform.python_version()}"


def _read_processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor() or platform.machine() or "unknown processor")
