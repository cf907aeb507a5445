"""Selection of the slow tests, which `pytest -m "not slow"` leaves out.

`make slow-tests` runs all tests, measures them and writes slow.txt: one test function on a line with its
time (s), its cases counted together. The functions that are not listed take at most `FAST_SECONDS`
together, without those of `ALWAYS_SELECTED`. A new test is fast until it is measured.
"""

import sys
import xml.etree.ElementTree as ET
from collections import defaultdict
from pathlib import Path

LIST = Path(__file__).with_name("slow.txt")
#: Processor time (s) of all fast tests together.
FAST_SECONDS = 100.0
#: Modules whose tests are never slow: nearly every change of the code can break one of them.
ALWAYS_SELECTED = ("tests.test_architecture", "tests.test_language")


def read_slow_tests() -> dict[str, float]:
    """Return the times (s) of the slow test functions by name, e.g. `tests.envs.test_vector::test_reset`."""
    lines = LIST.read_text().splitlines() if LIST.exists() else []
    return {name: float(seconds) for name, seconds in map(str.split, lines)}


def module_name(node_id: str) -> str:
    """Return the name of a test's module from the id of the test."""
    path, _, rest = node_id.partition("[")[0].partition("::")
    classes = rest.split("::")[:-1]
    return ".".join([path.removesuffix(".py").replace("/", "."), *classes])


def test_name(module: str, test: str) -> str:
    """Return the name of a test function from the id of one of its cases."""
    return f"{module}::{test.partition('[')[0]}"


test_name.__test__ = False  # type: ignore[attr-defined]


def select_slow_tests(report: Path, fast_seconds: float = FAST_SECONDS) -> dict[str, float]:
    """Return the times (s) of the slowest test functions of a JUnit report, so that the others fit the limit."""
    seconds: defaultdict[str, float] = defaultdict(float)
    for case in ET.parse(report).getroot().iter("testcase"):
        if case.attrib["classname"] not in ALWAYS_SELECTED:
            seconds[test_name(case.attrib["classname"], case.attrib["name"])] += float(case.attrib["time"])
    total, slow = 0.0, {}
    for name in sorted(seconds, key=lambda name: (seconds[name], name)):
        total += seconds[name]
        if total > fast_seconds:
            slow[name] = seconds[name]
    return dict(sorted(slow.items()))


if __name__ == "__main__":
    found = select_slow_tests(Path(sys.argv[1]))
    LIST.write_text("".join(f"{name} {seconds:.1f}\n" for name, seconds in found.items()))
    print(f"{len(found)} test functions are slow; they are listed in {LIST}")
