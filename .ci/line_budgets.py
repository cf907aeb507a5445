"""Check that no package has more lines of Python than its budget, the last column of the table in CONTRIBUTING.md.

python .ci/line_budgets.py
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
_ROW = re.compile(r"^\| `([\w/]+)` \| (\d+) \|$", re.MULTILINE)


def count_lines() -> dict[str, int]:
    """Return the number of lines of Python of each package: each folder of the library and each other top folder."""
    tops = ["handover_marl", "givers", "receivers", "assets", "experiments", "tests"]
    files = {path: path.relative_to(ROOT).parts for top in tops for path in (ROOT / top).rglob("*.py")}
    counts: dict[str, int] = {}
    for path, parts in files.items():
        package = "/".join(parts[:2]) if parts[0] == "handover_marl" and len(parts) > 2 else parts[0]
        counts[package] = counts.get(package, 0) + len(path.read_text().splitlines())
    return counts


if __name__ == "__main__":
    budgets = {name: int(budget) for name, budget in _ROW.findall((ROOT / "CONTRIBUTING.md").read_text())}
    faults = [
        f"{package} has {count} lines of Python, its budget is {budgets.get(package, 0)}; remove code that repeats "
        "other code, or raise the budget in CONTRIBUTING.md and say why in the commit"
        for package, count in sorted(count_lines().items())
        if count > budgets.get(package, 0)
    ]
    sys.exit("\n".join(faults) or 0)
