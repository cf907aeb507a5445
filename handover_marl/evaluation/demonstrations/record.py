"""Recording of demonstrations: evaluation on a train split with a data set of its episodes."""

from typing import Literal, overload

from typing_extensions import Unpack

from handover_marl.datasets.splits import SPLITS
from handover_marl.episode.spaces import STATE, check_obs_mode, get_camera_data_kind
from handover_marl.errors import OptionError, check_name
from handover_marl.evaluation.benchmark import Evaluation
from handover_marl.evaluation.config import REPLAY, EvaluationConfig, EvaluationOptions, ExecutionConfig, build_configs
from handover_marl.evaluation.demonstrations.files import require_h5py
from handover_marl.evaluation.demonstrations.lerobot.arrow_files import require_lerobot_packages
from handover_marl.evaluation.demonstrations.lerobot.recorder import MAX_FPS
from handover_marl.evaluation.demonstrations.lerobot.summary import LeRobotSummary
from handover_marl.evaluation.demonstrations.lerobot.writer import LeRobotWriter
from handover_marl.evaluation.demonstrations.reader import Demonstrations
from handover_marl.evaluation.demonstrations.recorder import RecordingConfig
from handover_marl.evaluation.demonstrations.writer import DemonstrationWriter
from handover_marl.execution.options import forward_signature
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.camera.renderers import resolve_renderer

#: Choices of the episodes to record.
ALL, SUCCESS = "all", "success"
KEEP_CHOICES = (ALL, SUCCESS)
#: File formats of data sets: every decision, for exact replay; and frames at a constant rate.
MINARI, LEROBOT = "minari", "lerobot"
FORMATS = (MINARI, LEROBOT)
#: Frames per second of LeRobot's format.
DEFAULT_FPS = 20
_TRAIN = "train"


@overload
def demonstrate(
    setup: str | EvaluationConfig | None = ...,
    split: str = ...,
    receiver: PolicyLike = ...,
    giver: PolicyLike = ...,
    *,
    obs_mode: str = ...,
    keep: str = ...,
    format: Literal["minari"] = ...,
    fps: int | None = ...,
    execution: ExecutionConfig | None = ...,
    **options: Unpack[EvaluationOptions],
) -> Demonstrations: ...


@overload
def demonstrate(
    setup: str | EvaluationConfig | None = ...,
    split: str = ...,
    receiver: PolicyLike = ...,
    giver: PolicyLike = ...,
    *,
    obs_mode: str = ...,
    keep: str = ...,
    format: Literal["lerobot"],
    fps: int | None = ...,
    execution: ExecutionConfig | None = ...,
    **options: Unpack[EvaluationOptions],
) -> LeRobotSummary: ...


@forward_signature(EvaluationConfig, ExecutionConfig)
def demonstrate(
    setup: str | EvaluationConfig | None = None,
    split: str = _TRAIN,
    receiver: PolicyLike = "reactive",
    giver: PolicyLike = REPLAY,
    *,
    obs_mode: str = STATE,
    keep: str = ALL,
    format: str = MINARI,  # noqa: A002 - the name of the option
    fps: int | None = None,
    execution: ExecutionConfig | None = None,
    **options: Unpack[EvaluationOptions],
) -> Demonstrations | LeRobotSummary:
    """Record observations and actions of a receiver on the scenes of a train split.

    Args:
        setup: Official setup, "s0" to "s3", or a setup of other data; or a whole `handover_marl.EvaluationConfig`.
        split: "train"; other splits are not allowed.
        receiver: The policy to record, as for `benchmark`.
        giver: The person's policy, as for `evaluate_pair`.
        obs_mode: Observation mode of the data set, independent of the receiver's own mode: "state",
            or wrist camera data such as "pointcloud" or "state+rgbd".
        keep: Episodes to record: "all", with their outcome, or only those that end in "success".
        format: "minari" (HDF5; every decision, for exact replay) or "lerobot" (Parquet and video; frames
            at a constant rate).
        fps: Frames per second of the format "lerobot", 1 to 1000; default: 20.
        execution: Execution settings. The output folder gets the data set, results and a report; an
            interrupted recording resumes there.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        OptionError: The split is not the train split, no output folder is given, a required package is
            not installed, or an option does not apply to the format.
        UnknownNameError: Unknown observation mode, format or choice of episodes.
        HandoverError: The same errors as `evaluate_pair`.
    """
    config, execution = build_configs(setup, options, execution, split=split, receiver=receiver, giver=giver)
    check_name("keep", keep, KEEP_CHOICES)
    check_obs_mode(obs_mode)
    check_name("split", config.split, SPLITS)
    if config.split != _TRAIN:
        raise OptionError(
            f"split must be {_TRAIN!r}, got {config.split!r}: results on a split are invalid if its episodes were used "
            "for training"
        )
    if execution.folder is None:
        raise OptionError("demonstrations need an output folder; pass out= (--out DIR)")
    recording = RecordingConfig(obs_mode, keep == SUCCESS, _check_format(format, fps, execution))
    camera = config.camera
    if get_camera_data_kind(obs_mode) is not None:
        resolve_renderer(camera.renderer, config.physics)
    evaluation = Evaluation(config, execution, recording.describe(config))
    if recording.fps:
        with LeRobotWriter.open(execution.folder, evaluation.config, recording, execution.fresh) as lerobot_writer:
            evaluation.run([lerobot_writer])
            return lerobot_writer.assemble()
    with DemonstrationWriter.open(execution.folder, evaluation.config, recording, execution.fresh) as writer:
        evaluation.run([writer])
        writer.assemble()
    return Demonstrations(execution.folder)


def _check_format(name: str, fps: int | None, execution: ExecutionConfig) -> int:
    """Check the options of a file format; return its frames per second, 0 for "minari".

    Raises:
        UnknownNameError: Unknown format.
        OptionError: An option does not apply to the format, or a package is not installed.
    """
    check_name("format", name, FORMATS)
    if name == MINARI:
        if fps is not None:
            raise OptionError(
                f"fps must be left out with format={MINARI!r}, got {fps!r}: it records every decision; choose "
                f"format={LEROBOT!r} (--format {LEROBOT})"
            )
        require_h5py()
        return 0
    fps = DEFAULT_FPS if fps is None else fps
    if isinstance(fps, bool) or not isinstance(fps, int) or not 1 <= fps <= MAX_FPS:
        raise OptionError(f"fps must be an integer from 1 to {MAX_FPS}, got {fps!r}")
    if execution.shard is not None:
        raise OptionError(
            f"shard must be left out with format={LEROBOT!r}, got {execution.shard!r}: its data sets cannot be merged; "
            "select scenes and record into several folders, or use backend='ray' (--backend ray)"
        )
    require_lerobot_packages()
    return fps
