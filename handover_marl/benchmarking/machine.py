"""The machine in words, to go with times measured on it."""

import os
import platform
from pathlib import Path


def describe_machine() -> str:
    """Processor, cores and Python version."""
    return f"{_processor()}, {os.cpu_count()} cores, Python {platform.python_version()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor() or platform.machine() or "unknown processor")
