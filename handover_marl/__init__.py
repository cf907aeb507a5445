"""Human-to-robot object handovers as a two-agent PettingZoo environment.

env = handover_marl.parallel_env(setup="s0", split="train")      PettingZoo, both agents at once
env = handover_marl.env(setup="s0", split="train")               PettingZoo, one agent after the other
env = gymnasium.make("HandoverMARL/Receiver-v0", setup="s0")     Gymnasium, the robot alone
report = handover_marl.benchmark(setup="s3")                     HandoverSim's official protocol
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from handover_marl._version import __version__
from handover_marl.registration import register_environments

if TYPE_CHECKING:
    from handover_marl.benchmarking.agreement import agreement
    from handover_marl.benchmarking.crossplay import crossplay
    from handover_marl.benchmarking.report import Report
    from handover_marl.benchmarking.runner import benchmark, evaluate_pair
    from handover_marl.handover_env import HandoverEnv
    from handover_marl.make import env, parallel_env
    from handover_marl.protocol.status import EpisodeStatus
    from handover_marl.views import benchmark_env

__all__ = [
    "EpisodeStatus",
    "HandoverEnv",
    "Report",
    "__version__",
    "agreement",
    "benchmark",
    "benchmark_env",
    "crossplay",
    "env",
    "evaluate_pair",
    "parallel_env",
]

# Loaded at first use, so that the import itself stays quick.
_HOMES = {
    "EpisodeStatus": "handover_marl.protocol.status",
    "HandoverEnv": "handover_marl.handover_env",
    "Report": "handover_marl.benchmarking.report",
    "agreement": "handover_marl.benchmarking.agreement",
    "benchmark": "handover_marl.benchmarking.runner",
    "benchmark_env": "handover_marl.views",
    "crossplay": "handover_marl.benchmarking.crossplay",
    "env": "handover_marl.make",
    "evaluate_pair": "handover_marl.benchmarking.runner",
    "parallel_env": "handover_marl.make",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_environments()
