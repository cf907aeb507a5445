"""Human-to-robot object handovers as a two-agent PettingZoo environment.

env = handover_marl.parallel_env(setup="s0", split="train")      PettingZoo parallel environment
env = handover_marl.env(setup="s0", split="train")               PettingZoo AEC environment
env = handover_marl.control_agent(env, "receiver", "replay")     one agent to control
env = handover_marl.encode(env)                                  features and scaled outputs
env = handover_marl.vector_env(64, "receiver", "replay")         many environments at once
env = gymnasium.make("HandoverMARL/Receiver-v0", setup="s0")     Gymnasium environment of the robot
robot = handover_marl.as_receiver(network)                       function, network or file as a receiver
report = handover_marl.benchmark(setup="s3")                     official protocol of HandoverSim
table = handover_marl.strangers("yang2021", setup="s0")          evaluation with unseen partners
data = handover_marl.demonstrate(setup="s0", out="data/s0")      recorded episodes

These names are public: those in `__all__` of this package and of `handover_marl.givers`,
`handover_marl.receivers` and `handover_marl.testing`, all errors and configurations, and every name on
the pages of the documentation. Other names may change at any time.
"""

from importlib import import_module
from typing import Any

from handover_marl.registration import register_environments
from handover_marl.version import __version__

# Public names by module, imported at first use to keep the import fast; `__init__.pyi` has their types.
_NAMES = {
    "config": ("CAMERAS", "CameraConfig", "WorldConfig", "make_camera"),
    "envs.config": ("EnvConfig",),
    "envs.constructors": ("env", "parallel_env"),
    "envs.custom_rewards": ("combine_rewards",),
    "envs.handover_env": ("HandoverEnv",),
    "envs.rewards": ("RewardWeights",),
    "envs.transition": ("Transition",),
    "envs.vector.vector_env": ("vector_env",),
    "envs.wrappers.encode": ("encode",),
    "envs.wrappers.control_agent": ("control_agent",),
    "episode.camera_observations": ("CameraCapture",),
    "episode.referee": ("EpisodeStatus",),
    "evaluation.benchmark": ("benchmark", "evaluate_pair"),
    "evaluation.comparison": ("compare",),
    "evaluation.config": ("EvaluationConfig", "ExecutionConfig"),
    "evaluation.crossplay": ("crossplay",),
    "evaluation.demonstrations.demonstration": ("Demonstrations",),
    "evaluation.demonstrations.record": ("demonstrate",),
    "evaluation.rendering": ("render_scene",),
    "evaluation.reports.report": ("Report", "load_report"),
    "evaluation.strangers.protocol": ("strangers",),
    "evaluation.verification": ("verify",),
    "learning.action_scheme": ("ActionScheme",),
    "learning.adapters.as_policy": ("as_giver", "as_receiver"),
    "learning.adapters.export": ("export_policy",),
    "learning.custom_encodings": ("FeatureExtractor", "declare_size"),
    "simulation.camera.images": ("SegmentationLabel",),
    "simulation.camera.noise": ("CameraNoise",),
    "simulation.camera.randomization": ("CameraRandomization",),
}
_MODULES = {name: f"{__name__}.{module}" for module, names in _NAMES.items() for name in names}

__all__ = ["__version__", *_MODULES]


def __getattr__(name: str) -> Any:
    if name in ("givers", "receivers", "testing"):
        return import_module(f"{__name__}.{name}")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_environments()
