"""Registration of the environments with PettingZoo and Gymnasium."""

import gymnasium
import pettingzoo

PETTINGZOO_ID = "HandoverMARL/Handover-v0"
RECEIVER_ID = "HandoverMARL/Receiver-v0"
GIVER_ID = "HandoverMARL/Giver-v0"

_CONSTRUCTORS = "handover_marl.envs.constructors"


def register_environments() -> None:
    """Register the two-agent environment with PettingZoo and the single-agent ones with Gymnasium, by their IDs."""
    # gymnasium.make() does not accept a ParallelEnv.
    pettingzoo.register("parallel", PETTINGZOO_ID, f"{_CONSTRUCTORS}:parallel_env")
    pettingzoo.register("aec", PETTINGZOO_ID, f"{_CONSTRUCTORS}:env")
    for name, agent in ((RECEIVER_ID, "receiver"), (GIVER_ID, "giver")):
        gymnasium.register(
            name,
            f"{_CONSTRUCTORS}:single_agent_env",
            vector_entry_point="handover_marl.envs.vector.vector_env:vector_env",
            kwargs={"agent": agent},
        )
