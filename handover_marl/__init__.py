"""Human-to-robot object handovers as a two-agent PettingZoo environment.

env = handover_marl.parallel_env(setup="s0", split="train")      PettingZoo, both agents at once
env = handover_marl.env(setup="s0", split="train")               PettingZoo, one agent after the other
env = handover_marl.freeze(env, "receiver", "replay")            one agent, the other frozen to a policy
env = handover_marl.encode(env)                                  features and outputs as networks want them
env = handover_marl.flatten(env)                                 vectors instead of dictionaries
env = handover_marl.homogeneous(env)                             equal spaces for all agents
env = handover_marl.vector_env(64, "receiver", "replay")         many environments in one process
env = gymnasium.make("HandoverMARL/Receiver-v0", setup="s0")     Gymnasium, the robot alone
report = handover_marl.benchmark(setup="s3")                     HandoverSim's official protocol
data = handover_marl.demonstrate(setup="s0", out="data/s0")      episodes as a data set

What stands in `__all__`, here and in `handover_marl.givers`, `handover_marl.receivers` and `handover_marl.testing`, is
public, and so are the errors, the configurations and what the documentation names; the rest may change at any time.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from handover_marl._version import __version__

if TYPE_CHECKING:
    from handover_marl.benchmarking.agreement import agreement
    from handover_marl.benchmarking.comparison import compare
    from handover_marl.benchmarking.crossplay import crossplay
    from handover_marl.benchmarking.evaluation import evaluate
    from handover_marl.benchmarking.report import Report
    from handover_marl.benchmarking.runner import benchmark, evaluate_pair
    from handover_marl.config import WorldConfig
    from handover_marl.demonstrations.demonstrate import demonstrate
    from handover_marl.demonstrations.demonstrations import Demonstrations
    from handover_marl.envs.constructors import benchmark_env, env, parallel_env
    from handover_marl.envs.encode import encode
    from handover_marl.envs.flatten import flatten
    from handover_marl.envs.freeze import freeze
    from handover_marl.envs.handover_env import HandoverEnv
    from handover_marl.envs.homogeneous import homogeneous
    from handover_marl.envs.vector_env import vector_env
    from handover_marl.episode.sight import View
    from handover_marl.merging.merge import merge
    from handover_marl.pictures.plan_picture import render_plan
    from handover_marl.pictures.rendering import render_scene
    from handover_marl.protocol.status import EpisodeStatus
    from handover_marl.run import Execution, Run
    from handover_marl.sim.camera.imperfections import CameraImperfections
    from handover_marl.sim.camera.photo import Seen

__all__ = [
    "CameraImperfections",
    "Demonstrations",
    "EpisodeStatus",
    "Execution",
    "HandoverEnv",
    "Report",
    "Run",
    "Seen",
    "View",
    "WorldConfig",
    "__version__",
    "agreement",
    "benchmark",
    "benchmark_env",
    "compare",
    "crossplay",
    "demonstrate",
    "encode",
    "env",
    "evaluate",
    "evaluate_pair",
    "flatten",
    "freeze",
    "homogeneous",
    "merge",
    "parallel_env",
    "render_plan",
    "render_scene",
    "vector_env",
]

# Loaded at first use, so that the import itself stays quick.
_HOMES = {
    "CameraImperfections": "sim.camera.imperfections",
    "Demonstrations": "demonstrations.demonstrations",
    "EpisodeStatus": "protocol.status",
    "Execution": "run",
    "HandoverEnv": "envs.handover_env",
    "Report": "benchmarking.report",
    "Run": "run",
    "Seen": "sim.camera.photo",
    "View": "episode.sight",
    "WorldConfig": "config",
    "agreement": "benchmarking.agreement",
    "benchmark": "benchmarking.runner",
    "benchmark_env": "envs.constructors",
    "compare": "benchmarking.comparison",
    "crossplay": "benchmarking.crossplay",
    "demonstrate": "demonstrations.demonstrate",
    "encode": "envs.encode",
    "env": "envs.constructors",
    "evaluate": "benchmarking.evaluation",
    "evaluate_pair": "benchmarking.runner",
    "flatten": "envs.flatten",
    "freeze": "envs.freeze",
    "homogeneous": "envs.homogeneous",
    "merge": "merging.merge",
    "parallel_env": "envs.constructors",
    "render_plan": "pictures.plan_picture",
    "render_scene": "pictures.rendering",
    "vector_env": "envs.vector_env",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _prepare() -> None:
    """Check the installation, and tell PettingZoo and Gymnasium where the environments are."""
    if find_spec("handover_marl.givers") is None:
        raise ImportError(
            f"{__file__} stands before the installed handover_marl and has no givers, receivers and assets: leave this "
            "folder, or install it as it stands (pip install -e .)"
        )
    from handover_marl.registration import register_environments

    register_environments()


_prepare()
