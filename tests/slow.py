"""Which tests are slow, as measured; `pytest -m "not slow"` leaves them out.

    python -m pytest -n auto --junitxml=times.xml && python -m tests.slow times.xml

The list is in slow.txt, a test function a line, its cases together. A new test counts as quick until it is measured; a
test may also be marked by hand (`@pytest.mark.slow`).
"""

import sys
import xml.etree.ElementTree as ET
from collections import defaultdict
from pathlib import Path

LIST = Path(__file__).with_name("slow.txt")
#: Tests whose cases together take longer (s) are slow.
LONGEST = 2.0


def slow_tests() -> frozenset[str]:
    """Names of slow test functions, such as `tests.envs.test_vector::test_sixteen_run_side_by_side`."""
    return frozenset(LIST.read_text().split()) if LIST.exists() else frozenset()


def name_of(module: str, test: str) -> str:
    """A test function's name, whichever case of it."""
    return f"{module}::{test.partition('[')[0]}"


def measured(report: Path) -> list[str]:
    """Names of the tests that a JUnit report found slow, sorted."""
    seconds: defaultdict[str, float] = defaultdict(float)
    for case in ET.parse(report).getroot().iter("testcase"):
        seconds[name_of(case.attrib["classname"], case.attrib["name"])] += float(case.attrib["time"])
    return sorted(name for name, time in seconds.items() if time > LONGEST)


if __name__ == "__main__":
    names = measured(Path(sys.argv[1]))
    LIST.write_text("".join(f"{name}\n" for name in names))
    print(f"{len(names)} test functions are slow")
