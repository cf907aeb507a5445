"""Recording of demonstrations: evaluation on a train split with a data set of its episodes."""

from typing_extensions import Unpack

from handover_marl.datasets.splits import check_setup_and_split
from handover_marl.episode.spaces import STATE, check_obs_mode, get_camera_data
from handover_marl.errors import OptionError, check_name
from handover_marl.evaluation.benchmark import Evaluation
from handover_marl.evaluation.config import REPLAY, EvaluationConfig, EvaluationOptions, ExecutionConfig, build_configs
from handover_marl.evaluation.demonstrations.files import require_h5py
from handover_marl.evaluation.demonstrations.reader import Demonstrations
from handover_marl.evaluation.demonstrations.recorder import RecordingConfig
from handover_marl.evaluation.demonstrations.writer import open_demonstration_writer
from handover_marl.execution.options import forward_signature
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.camera.renderers import resolve_renderer

#: Choices of the episodes to record.
ALL, SUCCESS = "all", "success"
KEEP_CHOICES = (ALL, SUCCESS)
_TRAIN = "train"


@forward_signature(EvaluationConfig, ExecutionConfig)
def demonstrate(
    setup: str | EvaluationConfig = "s0",
    split: str = _TRAIN,
    receiver: PolicyLike = "reactive",
    giver: PolicyLike = REPLAY,
    *,
    obs_mode: str = STATE,
    keep: str = ALL,
    execution: ExecutionConfig | None = None,
    **options: Unpack[EvaluationOptions],
) -> Demonstrations:
    """Record observations and actions of a receiver on the scenes of a train split.

    Args:
        setup: Official setup, "s0" to "s3"; or a whole `handover_marl.EvaluationConfig`.
        split: "train"; other splits are not allowed.
        receiver: The policy to record, as for `benchmark`.
        giver: The person's policy, as for `evaluate_pair`.
        obs_mode: Observation mode of the data set, whatever that of the receiver: "state", or wrist
            camera data such as "pointcloud" or "state+rgbd".
        keep: Episodes to record: "all", with their outcome, or only those that end in "success".
        execution: Execution settings. The output folder gets the data set, results and a report; an
            interrupted recording resumes there.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        OptionError: The split is not the train split, no output folder is given, or a required
            package is not installed.
        UnknownNameError: Unknown observation mode or choice of episodes.
        HandoverError: The same errors as `evaluate_pair`.
    """
    config, execution = build_configs(setup, options, execution, split=split, receiver=receiver, giver=giver)
    check_name("keep", keep, KEEP_CHOICES)
    check_obs_mode(obs_mode)
    check_setup_and_split(config.setup, config.split)
    if config.split != _TRAIN:
        raise OptionError(
            f"split must be {_TRAIN!r}, got {config.split!r}: results on a split are invalid if its episodes were used "
            "for training"
        )
    if execution.folder is None:
        raise OptionError("demonstrations need an output folder; pass out= (--out DIR)")
    require_h5py()
    resolve_renderer(config.camera.renderer, config.physics, installed=get_camera_data(obs_mode) is not None)
    recording = RecordingConfig(obs_mode, keep == SUCCESS)
    evaluation = Evaluation(config, execution, recording.describe(config))
    with open_demonstration_writer(execution.folder, evaluation.config, recording, execution.fresh) as writer:
        evaluation.run([writer])
        writer.assemble()
    return Demonstrations(execution.folder)
