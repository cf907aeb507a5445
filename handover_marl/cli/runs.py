"""Commands that simulate scenes and print a table, or record episodes."""

from typing import Annotated, Any, Literal

import tyro

from handover_marl.cli.options import (
    ExecutionArguments,
    OfficialSceneArguments,
    PairArguments,
    PopulationName,
    Progress,
    ReceiverArguments,
    RenderArguments,
    SceneArguments,
    TableArguments,
    Trust,
)
from handover_marl.cli.streams import print_tables
from handover_marl.config import CameraConfig
from handover_marl.evaluation.benchmark import benchmark, evaluate_pair
from handover_marl.evaluation.config import ExecutionConfig
from handover_marl.evaluation.crossplay import crossplay
from handover_marl.evaluation.demonstrations.record import demonstrate
from handover_marl.evaluation.rendering import render_scene
from handover_marl.evaluation.strangers.protocol import strangers
from handover_marl.simulation.engines import FAST

_EXECUTION, _VAL_PAIR, _VAL_SCENES = ExecutionArguments(), PairArguments(split="val"), SceneArguments(split="val")
_STRANGERS, _TABLES = OfficialSceneArguments(physics=FAST), TableArguments()
_Point = Annotated[tuple[float, float, float], tyro.conf.arg(metavar="X Y Z")]
_Policies = Annotated[tuple[str, ...], tyro.conf.arg(metavar="POLICY [POLICY ...]")]
_OptionalPolicies = Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="POLICY [POLICY ...]")]


def run_benchmark(
    evaluation: ReceiverArguments = ReceiverArguments(),
    execution: ExecutionArguments = _EXECUTION,
    tables: TableArguments = _TABLES,
) -> None:
    """Evaluate a receiver by HandoverSim's official protocol and print the table."""
    report = benchmark(**evaluation.get_fields(), **vars(execution))
    print_tables(report, tables, _describe_path(execution, "report.html"))


def run_evaluate_pair(
    evaluation: PairArguments = _VAL_PAIR, execution: ExecutionArguments = _EXECUTION, tables: TableArguments = _TABLES
) -> None:
    """Evaluate a giver with a receiver on a split and print the table."""
    report = evaluate_pair(**evaluation.get_fields(), **vars(execution))
    print_tables(report, tables, _describe_path(execution, "report.html"))


def run_crossplay(
    givers: _Policies = ("replay", "cooperative", "hesitant"),
    receivers: _Policies = ("hold", "yang2021"),
    evaluation: SceneArguments = _VAL_SCENES,
    execution: ExecutionArguments = _EXECUTION,
    tables: TableArguments = _TABLES,
) -> None:
    """Evaluate every giver with every receiver and print the success rates.

    Args:
        givers: Givers; the first is the baseline to which the rates of the others are compared.
        receivers: Receivers.
    """
    result = crossplay(givers, receivers, **evaluation.get_fields(), **vars(execution))
    print_tables(result, tables, _describe_path(execution, "crossplay.md"))


def run_strangers(
    receiver: _OptionalPolicies = None,
    giver: _OptionalPolicies = None,
    population: PopulationName = "strangers-v1",
    partners: Literal["train", "test", "all"] = "test",
    n_scenes: int = 36,
    evaluation: OfficialSceneArguments = _STRANGERS,
    execution: ExecutionArguments = _EXECUTION,
    tables: TableArguments = _TABLES,
) -> None:
    """Evaluate a receiver, or a giver, with unseen partners from a population.

    Args:
        receiver: Receiver to evaluate, or several trainings of one method.
        giver: Giver to evaluate with receivers, in place of a receiver.
        partners: Families of the population to evaluate with.
        n_scenes: Number of scenes, evenly spaced over the split; a large number takes all.
    """
    options = evaluation.get_fields() | {"receiver": receiver, "giver": giver}
    report = strangers(population=population, partners=partners, n_scenes=n_scenes, **options, **vars(execution))
    print_tables(report, tables, _describe_path(execution, "strangers.md"))


def run_demonstrate(
    obs_mode: str = "state",
    keep: Literal["all", "success"] = "all",
    fps: int | None = None,
    evaluation: PairArguments = PairArguments(split="train", receiver="reactive"),
    execution: ExecutionArguments = _EXECUTION,
) -> None:
    """Record episodes of a train split for imitation learning; --out DIR is required.

    Args:
        obs_mode: Observation mode of the recording: parts joined by +, e.g. state+rgbd; the receiver may use another.
        keep: Episodes to store: all (with their outcomes), or only those with success.
        fps: Frames per second (1 to 1000) to record; default: every decision of the receiver, for exact replay.
    """
    result = demonstrate(**evaluation.get_fields(), obs_mode=obs_mode, keep=keep, fps=fps, **vars(execution))
    print(f"{result}\n\n{_describe_path(execution, 'report.html')}", flush=True)


def run_render(
    scene: int,
    out: Annotated[str, tyro.conf.arg(metavar="FILE")],
    receiver: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None,
    view: Literal["outside", "wrist"] = "outside",
    key_frames: int = 6,
    caption: bool = True,
    width: int = CameraConfig.width,
    height: int = CameraConfig.height,
    position: _Point = CameraConfig.position,
    target: _Point = CameraConfig.target,
    vertical_fov: float = CameraConfig.vertical_fov,
    evaluation: RenderArguments = RenderArguments(),
    progress: Progress = True,
    trust: Trust = False,
) -> None:
    """Render a scene, or an episode in it.

    Args:
        scene: Number of the scene in its data set.
        out: Output file: .png for a grid of key frames, .gif or .mp4 for a video, .html for a 3D replay.
        receiver: The robot's policy; default: the robot stays at rest.
        view: outside, or wrist for the outside image above colors, depth and segmentation of the wrist camera.
        key_frames: Number of key frames of a .png.
        caption: Show the time and the state of the episode (released, contact, goal reached) in images and videos.
        width: Width of the outside camera's image in pixels.
        height: Height of the outside camera's image in pixels.
        position: Position of the outside camera in the world frame (m).
        target: Point in the world frame at the image's center (m).
        vertical_fov: Vertical field of view of the outside camera (degrees).
    """
    camera = CameraConfig(width, height, vertical_fov, position=position, target=target)
    # Without a receiver the robot is at rest, whatever the default of evaluations is.
    options: Any = evaluation.get_fields() | {"receiver": receiver, "camera": camera, "trust": trust}
    options |= {"view": view, "key_frames": key_frames, "caption": caption, "progress": progress}
    print(render_scene(scene, out, **options), flush=True)


def _describe_path(execution: ExecutionConfig, report: str) -> str:
    folder = ExecutionConfig(**vars(execution)).folder
    return f"Report: {folder / report}" if folder else "Report not saved; add --out DIR."
