"""Measure the cost of the wrist camera and the agreement of its renderers.

    python experiments/speed/bench_wrist_camera.py --data-dir DIR --out wrist_camera.md

Frames are rendered at times spread evenly over episodes of a receiver in fast physics. All times
are CPU times of one process. Whole environments alternate within one run, so that drift of the
machine's speed cancels.
"""

import time
from dataclasses import dataclass

import numpy as np
import tyro
from measuring import OutputArgs, describe_conditions, measure_peak_memory
from rich.console import Console
from rich.progress import track

from handover_marl.config import OFFICIAL_CONFIG, PANDA_DOF
from handover_marl.datasets import Dataset
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.camera_observations import WristCamera, WristCameraConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.learning.training.scene_arguments import DatasetArgs
from handover_marl.policies.reference import parse_policy
from handover_marl.simulation.camera.images import CameraImage, SegmentationLabel
from handover_marl.simulation.camera.ray_camera import RayCamera

SETUPS = ("s0", "s1", "s2", "s3")


@dataclass(frozen=True)
class Args(DatasetArgs, OutputArgs):
    """Options of the measurement of the wrist camera's renderers.

    Attributes:
        robot: Robot model: panda or panda_camera.
        scenes: Number of scenes, taken from the validation splits of all setups.
        views: Number of rendered frames per scene.
        receiver: Name of the receiver that moves the camera.
        period: Time (s) between two point clouds.
        steps_per_repetition: Number of control steps of one environment in a repetition.
        repetitions: Number of times that each environment is measured, in turn; 0 measures the renderers
            alone, not the steps of complete environments.
    """

    robot: str = "panda_camera"
    scenes: int = 50
    views: int = 4
    receiver: str = "yang2021"
    period: float = 0.15
    steps_per_repetition: int = 20
    repetitions: int = 10


class PointCloudTimer(EpisodeCallback):
    """Callback that measures the time to compute point clouds at a constant period.

    Args:
        period: Number of physics steps between two point clouds.

    Attributes:
        times: CPU time (s) of every point cloud.
    """

    def __init__(self, period: int) -> None:
        self.times: list[float] = []
        self._period = period
        self._wrist_camera = WristCamera(WristCameraConfig(renderer="rays"), "fast", OFFICIAL_CONFIG.physics)

    def on_reset(self, episode: Episode) -> None:
        """Load the scene's models, so that loading is not part of the measured times."""
        self._wrist_camera.reset(episode.scene, episode.world)
        self._wrist_camera.observe("pointcloud", episode.world, 0)

    def on_step(self, episode: Episode) -> None:
        """Compute a point cloud and record its CPU time, if a period has passed."""
        if episode.steps % self._period == 0:
            started = time.process_time()
            self._wrist_camera.observe("pointcloud", episode.world, episode.steps)
            self.times.append(time.process_time() - started)


class RendererComparison(EpisodeCallback):
    """Callback that renders frames of one episode with both renderers.

    Args:
        steps: Physics steps at which frames are rendered.
        camera: Ray caster of the episode's scene.

    Attributes:
        pairs: Images of the same frame by PyBullet and by the ray caster.
        times: Three CPU times (s) for each frame: of object and hand by the ray caster, of the whole
            image by the ray caster, and of the whole image by PyBullet.
    """

    def __init__(self, steps: list[int], camera: RayCamera) -> None:
        self.pairs: list[tuple[CameraImage, CameraImage]] = []
        self.times: list[tuple[float, ...]] = []
        self._steps, self._camera = set(steps), camera

    def on_step(self, episode: Episode) -> None:
        """Render the frame with both renderers at the chosen physics steps."""
        if episode.steps not in self._steps:
            return
        world, now = episode.world, episode.world.read_joint_snapshot()
        stamps = [time.process_time()]
        self._camera.render_targets(now)
        stamps.append(time.process_time())
        rays = self._camera.render_wrist_camera(now, color=False)
        stamps.append(time.process_time())
        bullet = world.render_wrist_camera(None, color=False)
        stamps.append(time.process_time())
        self.pairs.append((bullet, rays))
        self.times.append(tuple(np.diff(stamps).tolist()))


def compare_renderers(args: Args, data: Dataset) -> tuple[PointCloudTimer, RendererComparison]:
    """Simulate all scenes with both callbacks; return them with their images and CPU times."""
    scenes = list(dict.fromkeys(scene for setup in SETUPS for scene in data.list_scenes(setup, "val")))
    chosen = [scenes[int(place)] for place in np.linspace(0, len(scenes) - 1, min(args.scenes, len(scenes)))]
    episode = Episode("fast")
    robot = parse_policy("receiver", args.receiver).make(data)
    cloud_timer, found = (
        PointCloudTimer(round(1000 * args.period)),
        RendererComparison([], RayCamera(data.load_scene(0).assets, OFFICIAL_CONFIG.physics)),
    )
    for scene_id in track(chosen, "views", console=Console(stderr=True)):
        scene = data.load_scene(scene_id)
        episode.reset(scene)
        run_episode(episode, robot, seed=0, callbacks=[cloud_timer])
        steps = np.linspace(0, episode.steps, args.views + 1)[1:].astype(int).tolist()
        comparison = RendererComparison(steps, RayCamera(scene.assets, OFFICIAL_CONFIG.physics))
        episode.reset(scene)
        run_episode(episode, robot, seed=0, callbacks=[comparison])
        found.pairs += comparison.pairs
        found.times += comparison.times
    episode.close()
    return cloud_timer, found


def make_agreement_table(pairs: list[tuple[CameraImage, CameraImage]]) -> str:
    """Return a table of the agreement of two renderers in mask and depth, by segmentation label.

    Args:
        pairs: Images of the same frames by both renderers.
    """
    rows = []
    for label in SegmentationLabel:
        masks = [(first.compute_mask(label), second.compute_mask(label)) for first, second in pairs]
        either = sum(int((one | other).sum()) for one, other in masks)
        both = sum(int((one & other).sum()) for one, other in masks)
        if not either:
            continue
        depth_errors = np.concatenate(
            [
                np.abs(first.depth - second.depth)[one & other]
                for (first, second), (one, other) in zip(pairs, masks, strict=True)
            ]
        )
        near = f"{100.0 * np.mean(depth_errors <= 1e-4):.3f}"
        spread = [f"{value:.1e}" for value in (*np.percentile(depth_errors, [50, 99]), depth_errors.max())]
        rows.append([label.name.lower(), either, f"{100.0 * both / either:.4f}", near, *spread])
    header = ["label", "pixels", "mask IoU %", "depth within 1e-4 m %", "median m", "99 % m", "max m"]
    return format_table(header, rows)


def make_time_table(cloud_timer: PointCloudTimer, comparison: RendererComparison) -> str:
    """Return a table of the CPU times of point clouds and rendered frames."""
    targets, whole, bullet = zip(*comparison.times, strict=True)
    rows = []
    for name, seconds in (
        ("cloud of a decision (rays)", cloud_timer.times),
        ("object and hand (rays)", targets),
        ("whole image (rays)", whole),
        ("whole image (bullet)", bullet),
    ):
        times = [f"{1000.0 * value:.2f}" for value in (*np.percentile(seconds, [50, 95]), np.mean(seconds))]
        rows.append([name, len(seconds), *times])
    return format_table(["224 x 224", "views", "median ms", "95 % ms", "mean ms"], rows)


def make_env(args: Args, physics: str) -> HandoverEnv:
    """Create an environment with point clouds in its observations."""
    return HandoverEnv(
        split="val",
        data_dir=args.data_dir,
        dataset=args.dataset,
        robot=args.robot,
        control_period=args.period,
        obs_mode="state+pointcloud",
        physics=physics,
    )


def time_steps(env: HandoverEnv, steps: int) -> float:
    """Return the CPU time (s) of a number of control steps at the start pose, without resets."""
    action = {"giver": np.zeros(8, dtype=np.float32), "receiver": np.zeros(PANDA_DOF, dtype=np.float32)}
    action["receiver"][:] = env.config.world_config.physics.panda.start_joints
    seconds = 0.0
    for _ in range(steps):
        if not env.agents:
            env.reset()
        started = time.process_time()
        env.step(action)
        seconds += time.process_time() - started
    return seconds


def simulate_single_env(args: Args, physics: str) -> None:
    """Simulate three episodes; called in a separate process, whose memory is measured."""
    env = make_env(args, physics)
    for seed in range(3):
        env.reset(seed=seed)
        time_steps(env, args.steps_per_repetition)


def make_env_table(args: Args) -> str:
    """Return a table of the CPU time of a step and the peak memory of whole environments."""
    envs, rows = {}, []
    for name, physics in (("exact, bullet", "exact"), ("fast, rays", "fast")):
        rows.append([name, f"{measure_peak_memory(simulate_single_env, args, physics):.0f}"])
        envs[name] = make_env(args, physics)
        envs[name].reset(seed=0)
        time_steps(envs[name], args.steps_per_repetition)
    seconds: dict[str, list[float]] = {name: [] for name in envs}
    for _ in track(range(args.repetitions), "repetitions", console=Console(stderr=True)):
        for name, env in envs.items():
            seconds[name].append(time_steps(env, args.steps_per_repetition))
    ratios = np.array(seconds["exact, bullet"]) / np.array(seconds["fast, rays"])
    for row in rows:
        times = 1000.0 * np.array(seconds[row[0]]) / args.steps_per_repetition
        row.insert(1, f"{np.median(times):.2f}")
    rows[0].append("1")
    rows[1].append(f"{np.median(ratios):.1f} ({ratios.min():.1f} to {ratios.max():.1f})")
    return format_table(
        [f"points every {args.period} s", "ms per step", "MiB of a process with one", "times as fast"], rows
    )


def main(args: Args) -> None:
    """Print the tables and write them to the output file, if there is one."""
    data = args.open_dataset(args.robot)
    cloud_timer, found = compare_renderers(args, data)
    name = {"dexycb": "DexYCB", "synthetic": "synthetic scenes"}[data.name]
    parts = [
        f"{len(found.pairs)} views of {args.scenes} scenes of the validation splits, {name}, {args.robot}, receiver "
        f"{args.receiver}, fast physics. {describe_conditions()}.",
        make_agreement_table(found.pairs),
        make_time_table(cloud_timer, found),
    ]
    if args.repetitions:
        parts.append(make_env_table(args))
    args.publish("The wrist camera", *parts)


if __name__ == "__main__":
    main(tyro.cli(Args))
