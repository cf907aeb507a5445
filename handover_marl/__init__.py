"""Human-to-robot object handovers as a two-agent PettingZoo environment.

env = handover_marl.parallel_env(setup="s0", split="train")      PettingZoo parallel environment
env = handover_marl.env(setup="s0", split="train")               PettingZoo AEC environment
env = handover_marl.freeze(env, "receiver", "replay")            one agent to control
env = handover_marl.encode(env)                                  features and scaled outputs
env = handover_marl.flatten(env)                                 vectors instead of dictionaries
env = handover_marl.homogeneous(env)                             equal spaces for all agents
env = handover_marl.vector_env(64, "receiver", "replay")         many environments in one process
env = gymnasium.make("HandoverMARL/Receiver-v0", setup="s0")     Gymnasium environment of the robot
robot = handover_marl.as_receiver(network)                       function, network or file as a receiver
report = handover_marl.benchmark(setup="s3")                     official protocol of HandoverSim
table = handover_marl.strangers("yang2021", setup="s0")          partners that it has not met
data = handover_marl.demonstrate(setup="s0", out="data/s0")      recorded episodes

Public names are the names in `__all__`, here and in `handover_marl.givers`, `handover_marl.receivers`
and `handover_marl.testing`, the errors, the configurations, and all names on the pages of the
documentation. Other names may change at any time.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from handover_marl.registration import register_environments
from handover_marl.version import __version__

# Imported at first use, to keep the import fast; `__getattr__` reads these lines.
if TYPE_CHECKING:
    from handover_marl.config import WorldConfig as WorldConfig
    from handover_marl.envs.config import EnvConfig as EnvConfig
    from handover_marl.envs.constructors import benchmark_env as benchmark_env
    from handover_marl.envs.constructors import env as env
    from handover_marl.envs.constructors import parallel_env as parallel_env
    from handover_marl.envs.custom_rewards import combine_rewards as combine_rewards
    from handover_marl.envs.custom_rewards import declare_terms as declare_terms
    from handover_marl.envs.handover_env import HandoverEnv as HandoverEnv
    from handover_marl.envs.reward_terms import TermWeights as TermWeights
    from handover_marl.envs.transition import Transition as Transition
    from handover_marl.envs.vector.vector_env import vector_env as vector_env
    from handover_marl.envs.wrappers.encode import encode as encode
    from handover_marl.envs.wrappers.flatten import flatten as flatten
    from handover_marl.envs.wrappers.freeze import freeze as freeze
    from handover_marl.envs.wrappers.homogeneous import homogeneous as homogeneous
    from handover_marl.episode.camera_observations import CameraCapture as CameraCapture
    from handover_marl.episode.referee import EpisodeStatus as EpisodeStatus
    from handover_marl.evaluation.benchmark import benchmark as benchmark
    from handover_marl.evaluation.benchmark import evaluate_pair as evaluate_pair
    from handover_marl.evaluation.comparison import compare as compare
    from handover_marl.evaluation.comparison import compare_physics as compare_physics
    from handover_marl.evaluation.config import EvaluationConfig as EvaluationConfig
    from handover_marl.evaluation.config import ExecutionConfig as ExecutionConfig
    from handover_marl.evaluation.crossplay import crossplay as crossplay
    from handover_marl.evaluation.demonstrations.demonstration import Demonstrations as Demonstrations
    from handover_marl.evaluation.demonstrations.record import demonstrate as demonstrate
    from handover_marl.evaluation.merge import merge as merge
    from handover_marl.evaluation.rendering import render_plan as render_plan
    from handover_marl.evaluation.rendering import render_scene as render_scene
    from handover_marl.evaluation.reports.report import Report as Report
    from handover_marl.evaluation.reports.report_files import evaluate as evaluate
    from handover_marl.evaluation.strangers.protocol import strangers as strangers
    from handover_marl.evaluation.verification import verify as verify
    from handover_marl.learning.action_scheme import ActionScheme as ActionScheme
    from handover_marl.learning.adapters.as_policy import as_giver as as_giver
    from handover_marl.learning.adapters.as_policy import as_receiver as as_receiver
    from handover_marl.learning.adapters.export import export_policy as export_policy
    from handover_marl.learning.encodings.choices import declare_size as declare_size
    from handover_marl.learning.encodings.custom_features import FeatureExtractor as FeatureExtractor
    from handover_marl.simulation.camera.images import SegmentationLabel as SegmentationLabel
    from handover_marl.simulation.camera.noise import CameraNoise as CameraNoise

_IMPORT = re.compile(r"^    from (handover_marl\.[\w.]+) import (\w+) as", re.MULTILINE)
_MODULES = {name: module for module, name in _IMPORT.findall(Path(__file__).read_text())}

__all__ = ["__version__", *_MODULES]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_environments()
