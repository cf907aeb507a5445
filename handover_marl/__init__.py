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

import lazy_loader

from handover_marl.registration import register_environments

# The names in `__init__.pyi` are imported at first use, to keep the import fast.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

register_environments()
