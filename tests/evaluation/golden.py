"""Write the outcomes of synthetic scenes: `python -m tests.evaluation.golden` in the root of the repository.

Do so only if outcomes are meant to change, e.g. because the synthetic scenes or the receiver changed, and examine
the differences. The figures in README and docs then have to be computed again, too.
"""

import json
from pathlib import Path
from typing import Any

import handover_marl

FILE = Path(__file__).parents[1] / "golden" / "synthetic_outcomes.json"

#: Scenes of s0 val with different ends by physics.
SCENES = {"fast": (9, 14, 19), "exact": (19,)}

Outcomes = dict[str, list[Any]]


def outcomes(physics: str) -> Outcomes:
    """Simulate the scenes in a physics; return status, steps and release step of each, by its number."""
    report = handover_marl.benchmark(
        "s0", "val", "yang2021", scenes=SCENES[physics], dataset="synthetic", physics=physics, workers=1, progress=False
    )
    return {
        str(episode.scene_id): [episode.status.label, episode.steps, episode.release_step]
        for episode in report.episodes
    }


def text(by_physics: dict[str, Outcomes]) -> str:
    """Format outcomes as JSON with one line for each scene, so that a diff shows which scenes changed."""
    parts = []
    for physics, found in by_physics.items():
        rows = ",\n".join(f"    {json.dumps(scene)}: {json.dumps(outcome)}" for scene, outcome in found.items())
        parts.append(f"  {json.dumps(physics)}: {{\n{rows}\n  }}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def main() -> None:
    """Simulate the scenes, write their outcomes and print them."""
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_text(text({physics: outcomes(physics) for physics in SCENES}))
    print(FILE.read_text(), end="")


if __name__ == "__main__":
    main()
