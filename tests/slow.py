"""Selection of the slow tests, which `pytest -m "not slow"` leaves out.

`make slow-tests` runs all tests, measures them and writes slow.txt: one test function on a line, its
cases counted together. The functions that are not listed take at most `FAST_SECONDS` together. A new
test is fast until it is measured.
"""

import sys
import xml.etree.ElementTree as ET
from collections import defaultdict
from pathlib import Path

LIST = Path(__file__).with_name("slow.txt")
#: Processor time (s) of all fast tests together.
FAST_SECONDS = 100.0


def read_slow_tests() -> frozenset[str]:
    """Return the names of the slow test functions, e.g. `tests.envs.test_vector::test_reset`."""
    return frozenset(LIST.read_text().split()) if LIST.exists() else frozenset()


def test_name(module: str, test: str) -> str:
    """Return the name of a test function from the id of one of its cases."""
    return f"{module}::{test.partition('[')[0]}"


test_name.__test__ = False  # type: ignore[attr-defined]


def select_slow_tests(report: Path, fast_seconds: float = FAST_SECONDS) -> list[str]:
    """Return the slowest test functions of a JUnit report, sorted, so that the others fit the limit."""
    seconds: defaultdict[str, float] = defaultdict(float)
    for case in ET.parse(report).getroot().iter("testcase"):
        seconds[test_name(case.attrib["classname"], case.attrib["name"])] += float(case.attrib["time"])
    total, slow = 0.0, []
    for name in sorted(seconds, key=lambda name: (seconds[name], name)):
        total += seconds[name]
        if total > fast_seconds:
            slow.append(name)
    return sorted(slow)


if __name__ == "__main__":
    names = select_slow_tests(Path(sys.argv[1]))
    LIST.write_text("".join(f"{name}\n" for name in names))
    print(f"{len(names)} test functions are slow; they are listed in {LIST}")
