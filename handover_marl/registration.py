"""Names under which PettingZoo and Gymnasium find the environments."""

import gymnasium
import pettingzoo

PETTINGZOO_ID = "HandoverMARL/Handover-v0"
RECEIVER_ID = "HandoverMARL/Receiver-v0"
GIVER_ID = "HandoverMARL/Giver-v0"

_HOME = "handover_marl.envs.constructors"


def register_environments() -> None:
    """Register the two-agent environment with PettingZoo and the single-agent ones with Gymnasium."""
    # Only single agents go to Gymnasium: its make() does not take a ParallelEnv.
    pettingzoo.register("parallel", PETTINGZOO_ID, f"{_HOME}:parallel_env")
    pettingzoo.register("aec", PETTINGZOO_ID, f"{_HOME}:env")
    gymnasium.register(RECEIVER_ID, f"{_HOME}:receiver_env")
    gymnasium.register(GIVER_ID, f"{_HOME}:giver_env")
