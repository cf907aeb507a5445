"""Writes down how synthetic scenes end: `python -m tests.evaluation.golden` from the top of the tree.

Do so only when outcomes are meant to change, e.g. because the synthetic scenes or the receiver do, and look at what
changed. Figures in README and docs then have to be made anew too.
"""

import json
from pathlib import Path
from typing import Any

import handover_marl

FILE = Path(__file__).parents[1] / "golden" / "synthetic_outcomes.json"

#: Of s0 val: the first twelve in fast physics, and four of them, which end in different ways, in exact physics.
N_FAST = 12
EXACT = (9, 14, 19, 64)

Outcomes = dict[str, list[Any]]


def outcomes(physics: str) -> Outcomes:
    """Status, steps and release step of every scene by its number."""
    data = handover_marl.EvaluationConfig(dataset="synthetic").open_dataset()
    scenes = data.list_scenes("s0", "val")[:N_FAST] if physics == "fast" else EXACT
    report = handover_marl.benchmark(
        "s0",
        "val",
        "yang2021",
        scenes=scenes,
        dataset="synthetic",
        physics=physics,
        workers=1,
        progress=False,
    )
    return {
        str(episode.scene_id): [episode.status.label, episode.steps, episode.release_step]
        for episode in report.episodes
    }


def text(by_physics: dict[str, Outcomes]) -> str:
    """JSON with a scene a line, so that changes can be seen."""
    parts = []
    for physics, found in by_physics.items():
        rows = ",\n".join(f"    {json.dumps(scene)}: {json.dumps(outcome)}" for scene, outcome in found.items())
        parts.append(f"  {json.dumps(physics)}: {{\n{rows}\n  }}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def main() -> None:
    """Play and write."""
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_text(text({physics: outcomes(physics) for physics in ("fast", "exact")}))
    print(FILE.read_text(), end="")


if __name__ == "__main__":
    main()
