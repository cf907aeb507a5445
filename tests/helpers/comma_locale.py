"""Locale with a decimal comma, which need not be installed."""

import os
import struct
import sys
from pathlib import Path

import pytest

#: Name of the locale in a process with the environment that `install_comma_locale` returns.
COMMA = "comma"
_MAGIC, _CATEGORY = 0x20031115, 1


def install_comma_locale(folder: Path) -> dict[str, str]:
    """Write the locale's category LC_NUMERIC in the GNU C library's format; return the environment of its processes."""
    if not sys.platform.startswith("linux"):
        pytest.skip("needs the GNU C library")
    # Decimal point, separator of thousands, grouping, the first two as wide characters, and the character set.
    values = [b",\0", b"\0", b"\xff\xff", struct.pack("=I", ord(",")), struct.pack("=I", 0), b"UTF-8\0"]
    offsets, content, start = [], b"", 4 * (2 + len(values))
    for value in values:
        content += b"\0" * (-(start + len(content)) % 4 if len(value) == 4 else 0)
        offsets.append(start + len(content))
        content += value
    (folder / COMMA).mkdir(parents=True)
    header = struct.pack(f"={2 + len(values)}I", _MAGIC ^ _CATEGORY, len(values), *offsets)
    (folder / COMMA / "LC_NUMERIC").write_bytes(header + content)
    return os.environ | {"LOCPATH": str(folder)}
