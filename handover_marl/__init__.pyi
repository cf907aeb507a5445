"""Public names with their modules and types; `__init__.py` imports them at first use."""

from . import givers as givers
from . import receivers as receivers
from . import testing as testing
from .config import CAMERAS as CAMERAS
from .config import CameraConfig as CameraConfig
from .config import WorldConfig as WorldConfig
from .config import make_camera as make_camera
from .envs.config import EnvConfig as EnvConfig
from .envs.constructors import env as env
from .envs.constructors import parallel_env as parallel_env
from .envs.custom_rewards import combine_rewards as combine_rewards
from .envs.handover_env import HandoverEnv as HandoverEnv
from .envs.rewards import RewardWeights as RewardWeights
from .envs.transition import Transition as Transition
from .envs.vector.vector_env import vector_env as vector_env
from .envs.wrappers.control_agent import control_agent as control_agent
from .envs.wrappers.encode import encode as encode
from .episode.camera_observations import CameraCapture as CameraCapture
from .episode.referee import EpisodeStatus as EpisodeStatus
from .evaluation.benchmark import benchmark as benchmark
from .evaluation.benchmark import evaluate_pair as evaluate_pair
from .evaluation.comparison import compare as compare
from .evaluation.config import EvaluationConfig as EvaluationConfig
from .evaluation.config import ExecutionConfig as ExecutionConfig
from .evaluation.crossplay import crossplay as crossplay
from .evaluation.demonstrations.demonstration import Demonstrations as Demonstrations
from .evaluation.demonstrations.record import demonstrate as demonstrate
from .evaluation.rendering import render_scene as render_scene
from .evaluation.reports.report import Report as Report
from .evaluation.reports.report import load_report as load_report
from .evaluation.strangers.protocol import strangers as strangers
from .evaluation.verification import verify as verify
from .learning.action_scheme import ActionScheme as ActionScheme
from .learning.adapters.as_policy import as_giver as as_giver
from .learning.adapters.as_policy import as_receiver as as_receiver
from .learning.adapters.export import export_policy as export_policy
from .learning.custom_encodings import FeatureExtractor as FeatureExtractor
from .learning.custom_encodings import declare_size as declare_size
from .simulation.camera.images import SegmentationLabel as SegmentationLabel
from .simulation.camera.noise import CameraNoise as CameraNoise
from .simulation.camera.randomization import CameraRandomization as CameraRandomization

__version__: str
