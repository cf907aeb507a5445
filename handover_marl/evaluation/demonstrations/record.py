"""Recording of demonstrations: evaluation on a train split that keeps its episodes."""

from typing_extensions import Unpack

from handover_marl.datasets.splits import SPLITS
from handover_marl.episode.spaces import STATE, check_obs_mode, get_camera_data_kind
from handover_marl.errors import OptionError, check_name
from handover_marl.evaluation.benchmark import Evaluation
from handover_marl.evaluation.config import REPLAY, EvaluationConfig, EvaluationOptions, ExecutionConfig, build_configs
from handover_marl.evaluation.demonstrations.reader import Demonstrations
from handover_marl.evaluation.demonstrations.recorder import MAX_FPS, DemonstrationWriter, RecordingConfig
from handover_marl.execution.options import forward_signature
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.camera.renderers import resolve_renderer

#: Choices of the episodes to record.
ALL, SUCCESS = "all", "success"
KEEP_CHOICES = (ALL, SUCCESS)
_TRAIN = "train"


@forward_signature(EvaluationConfig, ExecutionConfig)
def demonstrate(
    setup: str | EvaluationConfig | None = None,
    split: str = _TRAIN,
    receiver: PolicyLike = "reactive",
    giver: PolicyLike = REPLAY,
    *,
    obs_mode: str = STATE,
    keep: str = ALL,
    fps: int | None = None,
    execution: ExecutionConfig | None = None,
    **options: Unpack[EvaluationOptions],
) -> Demonstrations:
    """Record observations and actions of both agents on the scenes of a train split.

    Args:
        setup: Official setup, "s0" to "s3", or a setup of other data; or a whole `handover_marl.EvaluationConfig`.
        split: "train"; other splits are not allowed.
        receiver: The policy to record, as for `benchmark`.
        giver: The person's policy, as for `evaluate_pair`.
        obs_mode: Recorded observation, independent of the receiver's own mode: "state", or wrist camera
            data such as "pointcloud" or "state+rgbd".
        keep: Episodes to record: "all", with their outcome, or only those that end in "success".
        fps: Frames per second, 1 to 1000, to record a constant rate; default: every decision of the receiver,
            for exact replay.
        execution: Execution settings. The output folder gets the episodes, results and a report; an
            interrupted recording resumes there.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        OptionError: The split is not the train split, no output folder is given, or `fps` is out of range.
        UnknownNameError: Unknown observation mode or choice of episodes.
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
    if fps is not None and (isinstance(fps, bool) or not isinstance(fps, int) or not 1 <= fps <= MAX_FPS):
        raise OptionError(f"fps must be an integer from 1 to {MAX_FPS}, got {fps!r}")
    if execution.folder is None:
        raise OptionError("demonstrations need an output folder; pass out= (--out DIR)")
    if get_camera_data_kind(obs_mode) is not None:
        resolve_renderer(config.camera.renderer, config.physics)
    recording = RecordingConfig(obs_mode, keep == SUCCESS, fps)
    evaluation = Evaluation(config, execution, recording.describe(config))
    writer = DemonstrationWriter(execution.folder, evaluation.config, recording)
    evaluation.run([writer])
    writer.delete_excluded()
    return Demonstrations(execution.folder)
