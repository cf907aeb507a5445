"""Commands that play scenes and print a table, or record episodes."""

from typing import Annotated, Literal

import tyro

from handover_marl.cli.run_options import BenchmarkRun, CrossPlayRun, expanded
from handover_marl.run import Execution, Run

_OFFICIAL, _CROSSPLAY = BenchmarkRun(), CrossPlayRun(split="val")
_Names = Annotated[str, tyro.conf.arg(metavar="POLICY,...")]


def run_benchmark(run: BenchmarkRun = _OFFICIAL, how: Execution = Execution()) -> None:
    """Run HandoverSim's official protocol and print its table.

    Args:
        run: What is run.
        how: How it is run; outcomes do not depend on it.
    """
    from handover_marl.benchmarking.runner import benchmark

    print(benchmark(run, execution=expanded(how)))


def run_pair(run: Run = Run(split="val"), how: Execution = Execution()) -> None:
    """Let any giver and any receiver play the scenes of a split and print the table.

    Args:
        run: What is run.
        how: How it is run; outcomes do not depend on it.
    """
    from handover_marl.benchmarking.runner import evaluate_run

    print(evaluate_run(run, expanded(how)))


def run_agreement(run: Run = Run(split="val"), against: str = "fast", how: Execution = Execution()) -> None:
    """Play the same scenes in exact and in fast or MuJoCo's physics and compare the outcomes.

    Args:
        run: What is run; its physics do not count.
        against: What exact physics are compared with, fast or mujoco.
        how: How it is run; outcomes do not depend on it.
    """
    from handover_marl.benchmarking.agreement import agreement

    print(agreement(run, against=against, execution=expanded(how)))


def run_crossplay(
    givers: _Names = "replay,cooperative,hesitant",
    receivers: _Names = "hold,yang2021",
    run: CrossPlayRun = _CROSSPLAY,
    how: Execution = Execution(),
) -> None:
    """Play every giver with every receiver and print who gets on with whom.

    Args:
        givers: Givers, with commas; gains are told over the first one.
        receivers: Receivers, with commas.
        run: What is run.
        how: How it is run; outcomes do not depend on it.
    """
    from handover_marl.benchmarking.crossplay import crossplay
    from handover_marl.policies.reference import split_names

    rows, columns = split_names("giver", givers), split_names("receiver", receivers)
    print(crossplay(rows, columns, run, execution=expanded(how)))


def run_demonstrate(
    sight: Literal["none", "points", "clouds", "images"] = "none",
    observe: Literal["all", "sight"] = "all",
    keep: Literal["all", "success"] = "all",
    run: Run = Run(split="train", receiver="reactive"),
    how: Execution = Execution(),
) -> None:
    """Record episodes of a train split as a data set in Minari's layout (--out DIR).

    Args:
        sight: What is recorded of the wrist camera, whatever the receiver itself looks at.
        observe: all, or sight: proprioception and sight alone.
        keep: all episodes, with their outcome, or only successes.
        run: What is run.
        how: How it is run; the data do not depend on it.
    """
    from handover_marl.demonstrations.demonstrate import demonstrate

    shown = None if sight == "none" else sight
    print(demonstrate(run, sight=shown, observe=observe, keep=keep, execution=expanded(how)))
