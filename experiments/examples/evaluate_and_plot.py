"""Evaluate receivers on the same scenes and plot their outcomes.

    python experiments/examples/evaluate_and_plot.py --dataset synthetic --out runs/outcomes.png

The script needs the extra `plot`. Bars show the share of scenes with each outcome; error bars are Wilson's
95 % intervals.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro
from matplotlib.figure import Figure

import handover_marl
from handover_marl.cli.options import SceneNumbers
from handover_marl.learning.training.scene_arguments import EvaluationArgs

OUTCOMES = ("success", "contact", "drop", "timeout")


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Arguments of the comparison of receivers.

    Attributes:
        receivers: Receivers: names with options, policy files (learned:FILE) or package:Class.
        giver: Name of the giver.
        out: Image file to write.
        split: Split of the setup: train, val or test.
        scenes: Scene numbers; default: all of the split.
    """

    receivers: tuple[str, ...] = ("hold", "yang2021", "yang2021:wait=3")
    giver: str = "replay"
    out: Path = Path("runs/outcomes.png")
    split: str = "val"
    scenes: SceneNumbers = None


def plot(reports: dict[str, handover_marl.Report], title: str) -> Figure:
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    width = 0.8 / len(reports)
    for number, (receiver, report) in enumerate(reports.items()):
        rates = report.to_json()["rates"]
        shares = [100.0 * rates[outcome]["rate"] for outcome in OUTCOMES]
        bounds = [[100.0 * bound for bound in rates[outcome]["interval_95"]] for outcome in OUTCOMES]
        below = [share - low for share, (low, _) in zip(shares, bounds, strict=True)]
        above = [high - share for share, (_, high) in zip(shares, bounds, strict=True)]
        positions = [index + width * number for index in range(len(OUTCOMES))]
        axes.bar(positions, shares, width, yerr=[below, above], capsize=3, label=receiver)
    axes.set_xticks([index + 0.4 - width / 2 for index in range(len(OUTCOMES))], OUTCOMES)
    axes.set_ylabel("scenes (%)")
    axes.set_ylim(0.0, 100.0)
    axes.set_title(title)
    axes.legend()
    return figure


def main(args: Args) -> dict[str, handover_marl.Report]:
    options = {name: value for name, value in vars(args).items() if name not in ("receivers", "out")}
    reports = {name: handover_marl.evaluate_pair(receiver=name, **options) for name in args.receivers}
    for receiver, report in reports.items():
        print(f"{receiver}\n{report}\n")
    first = next(iter(reports.values()))
    scenes = f"{len(first.episodes)} scenes of {first.metadata.setup} {args.split}"
    title = f"{scenes}, giver {args.giver}, {args.physics} physics"
    args.out.parent.mkdir(parents=True, exist_ok=True)
    plot(reports, title).savefig(args.out, dpi=120)
    print(args.out)
    return reports


if __name__ == "__main__":
    main(tyro.cli(Args))
