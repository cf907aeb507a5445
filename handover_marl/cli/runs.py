"""Commands that simulate scenes and print a table, or record episodes."""

from typing import Annotated, Literal

import tyro

from handover_marl.cli.options import BenchmarkArguments, CrossPlayArguments, PopulationName, StrangersArguments
from handover_marl.cli.printing import TableFormat, print_tables
from handover_marl.cli.streams import print_result
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig

_OFFICIAL, _CROSSPLAY = BenchmarkArguments(), CrossPlayArguments(split="val")
_STRANGERS = StrangersArguments(physics="fast")
_Names = Annotated[str, tyro.conf.arg(metavar="POLICY,...")]
_OptionalNames = Annotated[str | None, tyro.conf.arg(metavar="POLICY,...")]


def run_benchmark(
    evaluation: BenchmarkArguments = _OFFICIAL,
    execution: ExecutionConfig = ExecutionConfig(),
    table_format: TableFormat = "markdown",
) -> None:
    """Run HandoverSim's official protocol and print its table.

    Args:
        evaluation: Scenes, policies and simulation.
        execution: Workers and output; outcomes do not depend on them.
        table_format: Format of the printed tables.
    """
    from handover_marl.evaluation.benchmark import benchmark

    print_tables(benchmark(evaluation, execution=execution), table_format, _describe_path(execution, "report.html"))


def run_pair(
    evaluation: EvaluationConfig = EvaluationConfig(split="val"),
    execution: ExecutionConfig = ExecutionConfig(),
    table_format: TableFormat = "markdown",
) -> None:
    """Evaluate a giver with a receiver on a split and print the table.

    Args:
        evaluation: Scenes, policies and simulation.
        execution: Workers and output; outcomes do not depend on them.
        table_format: Format of the printed tables.
    """
    from handover_marl.evaluation.benchmark import evaluate_pair

    print_tables(evaluate_pair(evaluation, execution=execution), table_format, _describe_path(execution, "report.html"))


def run_agreement(
    evaluation: EvaluationConfig = EvaluationConfig(split="val"),
    against: str = "fast",
    execution: ExecutionConfig = ExecutionConfig(),
    table_format: TableFormat = "markdown",
) -> None:
    """Compare outcomes of the same scenes in exact and in other physics.

    Args:
        evaluation: Scenes, policies and simulation; the physics option is ignored.
        against: Physics to compare with exact physics, fast or mujoco.
        execution: Workers and output; outcomes do not depend on them.
        table_format: Format of the printed tables.
    """
    from handover_marl.evaluation.comparison import AGREEMENT_FILE, compare_physics

    result = compare_physics(evaluation, against=against, execution=execution)
    print_tables(result, table_format, _describe_path(execution, AGREEMENT_FILE))


def run_crossplay(
    givers: _Names = "replay,cooperative,hesitant",
    receivers: _Names = "hold,yang2021",
    evaluation: CrossPlayArguments = _CROSSPLAY,
    execution: ExecutionConfig = ExecutionConfig(),
    table_format: TableFormat = "markdown",
) -> None:
    """Evaluate every giver with every receiver and print the success rates.

    Args:
        givers: Comma-separated givers; the first one is the baseline of the others.
        receivers: Comma-separated receivers.
        evaluation: Scenes, policies and simulation.
        execution: Workers and output; outcomes do not depend on them.
        table_format: Format of the printed tables.
    """
    from handover_marl.evaluation.crossplay import crossplay
    from handover_marl.policies.reference import split_policy_list

    rows, columns = split_policy_list("giver", givers), split_policy_list("receiver", receivers)
    result = crossplay(rows, columns, evaluation, execution=execution)
    print_tables(result, table_format, _describe_path(execution, "crossplay.md"))


def run_strangers(
    receiver: _OptionalNames = None,
    giver: _OptionalNames = None,
    population: PopulationName = "strangers-v1",
    partners: Literal["train", "test", "all"] = "test",
    n_scenes: int = 36,
    references: Annotated[str | None, tyro.conf.arg(metavar="FILE.json")] = None,
    evaluation: StrangersArguments = _STRANGERS,
    execution: ExecutionConfig = ExecutionConfig(),
    table_format: TableFormat = "markdown",
) -> None:
    """Evaluate a receiver, or a giver, with partners of a population that it has not met.

    Args:
        receiver: Receiver to evaluate, or comma-separated trainings of one method.
        giver: Giver to evaluate with receivers, in place of a receiver.
        population: Name of a shipped population, or a file.
        partners: Families of the population.
        n_scenes: Number of scenes, evenly spaced over the split; a large number takes all.
        references: File of references, as `strangers-references` writes it; default: that of the population.
        evaluation: Scenes and simulation.
        execution: Workers and output; outcomes do not depend on them.
        table_format: Format of the printed tables.
    """
    from handover_marl.evaluation.strangers.protocol import strangers
    from handover_marl.policies.reference import split_policy_list

    report = strangers(
        None if receiver is None else split_policy_list("receiver", receiver),
        None if giver is None else split_policy_list("giver", giver),
        population,
        partners,
        n_scenes,
        evaluation,
        references=references,
        execution=execution,
    )
    print_tables(report, table_format, _describe_path(execution, "strangers.md"))


def run_demonstrate(
    obs_mode: Literal[
        "state",
        "state+pointcloud",
        "pointcloud",
        "state+rgbd",
        "rgbd",
        "state+full_pointcloud",
        "full_pointcloud",
        "state+scene_pointcloud",
        "scene_pointcloud",
    ] = "state",
    keep: Literal["all", "success"] = "all",
    fps: int | None = None,
    evaluation: EvaluationConfig = EvaluationConfig(split="train", receiver="reactive"),
    execution: ExecutionConfig = ExecutionConfig(),
) -> None:
    """Record episodes of a train split for imitation learning (--out DIR).

    Args:
        obs_mode: Observation mode of the recording, independent of the receiver's.
        keep: Episodes to store: all, with their outcomes, or success.
        fps: Frames per second, 1 to 1000, to record a constant rate; default: every decision, for exact replay.
        evaluation: Scenes, policies and simulation.
        execution: Workers and output; the data do not depend on them.
    """
    from handover_marl.evaluation.demonstrations.record import demonstrate

    result = demonstrate(evaluation, obs_mode=obs_mode, keep=keep, fps=fps, execution=execution)
    print_result(f"{result}\n\n{_describe_path(execution, 'report.html')}")


def _describe_path(execution: ExecutionConfig, report: str) -> str:
    return f"Report: {execution.folder / report}" if execution.folder else "Report not saved; add --out DIR."
