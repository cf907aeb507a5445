"""Measure the wrist cameras on a device: agreement with the ray caster of the processor, and time per image.

    python experiments/speed/bench_device_camera.py --data-dir DIR --device cuda

Frames are those of a receiver's episodes in MuJoCo's physics, rendered in one batch on the device and one after another
on the processor.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import tyro
from measuring import OutputArgs, describe_conditions, describe_device

from handover_marl.config import HAND_DOF, MAX_OBJECTS, OFFICIAL_CONFIG
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.geometry.arrays import ArrayFactory, make_tensor_factory, to_numpy
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.policies.reference import parse_policy
from handover_marl.simulation.camera.images import CameraImage, SegmentationLabel
from handover_marl.simulation.camera.ray_camera import RayCamera
from handover_marl.simulation.camera.warp_camera import ImageBatch, WarpCamera
from handover_marl.simulation.engines import CUDA, MUJOCO, WARP, BatchBackend, check_backend
from handover_marl.simulation.tensor_state import JointSnapshotBatch
from handover_marl.simulation.world import JointSnapshot

_DEPTH_M, _COLOR = 1e-4, 1


@dataclass(frozen=True)
class Args(SetupArgs, OutputArgs):
    """Options of the measurement.

    Attributes:
        scenes: Number of scenes of the validation split, spread evenly.
        views: Number of frames per scene.
        receiver: Name of the receiver that moves the camera.
        device: Device of the cameras: cuda, or cpu.
        repetitions: Number of times that all frames are rendered, after a first time that compiles kernels.
    """

    scenes: int = 20
    views: int = 4
    receiver: str = "yang2021"
    device: str = CUDA
    repetitions: int = 3


@dataclass(frozen=True, eq=False)
class Frame:
    """State of a scene in which both cameras render an image.

    Attributes:
        scene: The scene.
        snapshot: Joint positions.
        objects: Poses (m, 7) of the objects.
    """

    scene: Scene
    snapshot: JointSnapshot
    objects: npt.NDArray[np.float32]


class FrameRecorder(EpisodeCallback):
    """Callback that records the state of an episode at some physics steps."""

    def __init__(self, steps: list[int]) -> None:
        self.frames: list[Frame] = []
        self._steps = set(steps)

    def on_step(self, episode: Episode) -> None:
        """Record the state."""
        if episode.steps in self._steps:
            world = episode.world
            self.frames.append(Frame(episode.scene, world.read_joint_snapshot(), world.read_state().object_poses))


def record_frames(args: Args) -> list[Frame]:
    """Return frames at times spread evenly over episodes."""
    data = args.open_dataset()
    ids = data.list_scenes(args.resolve_setup().setup, "val")
    chosen = [ids[int(place)] for place in np.linspace(0, len(ids) - 1, min(args.scenes, len(ids)))]
    receiver, episode, frames = parse_policy("receiver", args.receiver).make(data), Episode(MUJOCO), []
    for scene in map(data.load_scene, chosen):
        episode.reset(scene)
        run_episode(episode, receiver, seed=0)
        recorder = FrameRecorder(np.linspace(0, episode.steps, args.views + 1)[1:].astype(int).tolist())
        episode.reset(scene)
        run_episode(episode, receiver, seed=0, callbacks=[recorder])
        frames += recorder.frames
    return frames


def stack_frames(frames: list[Frame], arrays: ArrayFactory) -> JointSnapshotBatch:
    """Return the states of frames as tensors."""
    objects = np.zeros((len(frames), MAX_OBJECTS, 7), dtype=np.float32)
    for own, frame in zip(objects, frames, strict=True):
        own[: len(frame.objects)] = frame.objects
    hands = [np.zeros(HAND_DOF, np.float32) if frame.snapshot.hand is None else frame.snapshot.hand for frame in frames]
    return JointSnapshotBatch(
        robot=arrays.asarray(np.array([frame.snapshot.robot for frame in frames])),
        hand=arrays.asarray(np.array(hands)),
        hand_present=arrays.asarray(np.array([frame.snapshot.hand is not None for frame in frames])),
        objects=arrays.asarray(objects),
    )


def measure(function: Callable[[], Any], count: int, repetitions: int, finish: Callable[[], None]) -> tuple[Any, float]:
    """Return a function's result and its time (ms) for each of `count` images; the first call is not measured."""
    result = function()
    finish()
    started = time.perf_counter()
    for _ in range(repetitions):
        function()
    finish()
    return result, 1e3 * (time.perf_counter() - started) / (repetitions * count)


def describe_agreement(found: ImageBatch, expected: list[CameraImage]) -> list[str]:
    """Return the agreement of whole images as sentences."""
    labels = to_numpy(found.segmentation)
    depth, rgb = to_numpy(found.depth), to_numpy(found.rgb).astype(int)
    others = np.stack([image.segmentation.ravel() for image in expected])
    same = labels == others
    is_near = np.abs(depth - np.stack([image.depth.ravel() for image in expected])) < _DEPTH_M
    colors = np.stack([np.asarray(image.rgb).reshape(-1, 3) for image in expected]).astype(int)
    is_alike = (np.abs(rgb - colors) <= _COLOR).all(axis=-1)
    counts = {label.name: int((others == label).sum()) for label in SegmentationLabel}
    return [
        f"Labels differ at {np.sum(~same)} of {same.size:,} pixels, at most {(~same).sum(axis=1).max()} of an image.",
        f"Where labels agree, depths differ by 0.1 mm or more at {np.sum(~is_near[same])} pixels, and colours by more "
        f"than {_COLOR} at {np.sum(~is_alike[same])}.",
        f"Pixels by label: {', '.join(f'{name} {count:,}' for name, count in counts.items())}.",
    ]


def main(args: Args) -> None:
    """Render all frames with both cameras, and print agreement and times."""
    check_backend(BatchBackend(WARP, args.device))
    frames, arrays = record_frames(args), make_tensor_factory(args.device)
    count, config = len(frames), OFFICIAL_CONFIG.physics
    camera, rows = WarpCamera(config, count, arrays), arrays.arange(count)
    for row, frame in enumerate(frames):
        camera.reset(row, frame.scene.assets)
    snapshots, singles = stack_frames(frames, arrays), [RayCamera(frame.scene.assets, config) for frame in frames]
    finish = arrays.xp.cuda.synchronize if args.device == CUDA else lambda: None
    pairs = list(zip(singles, (frame.snapshot for frame in frames), strict=True))
    tests: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = {
        "whole image with colours": (
            lambda: camera.render_wrist_camera(rows, snapshots, color=True),
            lambda: [single.render_wrist_camera(own, True) for single, own in pairs],
        ),
        "object and hand": (
            lambda: camera.render_targets(rows, snapshots),
            lambda: [single.render_targets(own) for single, own in pairs],
        ),
    }
    lines: list[tuple[str, str, str]] = []
    agreement: list[str] = []
    for name, (on_device, on_processor) in tests.items():
        found, device_ms = measure(on_device, count, args.repetitions, finish)
        expected, processor_ms = measure(on_processor, count, args.repetitions, lambda: None)
        lines.append((name, f"{device_ms:.3f}", f"{processor_ms:.3f}"))
        agreement = agreement or describe_agreement(found, expected)
    conditions = f"{count} images. Device: {describe_device(args.device)}. {describe_conditions()}."
    table = format_table(("content", "device, ms per image", "processor, ms per image"), lines)
    args.publish("Wrist cameras on a device", conditions, "\n".join(agreement), table)


if __name__ == "__main__":
    main(tyro.cli(Args))
