"""Names under which PettingZoo and Gymnasium find the environments."""

import gymnasium
import pettingzoo

PETTINGZOO_ID = "HandoverMARL/Handover-v0"
RECEIVER_ID = "HandoverMARL/Receiver-v0"
GIVER_ID = "HandoverMARL/Giver-v0"


def register_environments() -> None:
    """Register the two-agent environment with PettingZoo and the single-agent views with Gymnasium."""
    # Only views go to Gymnasium: its make() does not take a ParallelEnv.
    pettingzoo.register("parallel", PETTINGZOO_ID, "handover_marl.make:parallel_env")
    pettingzoo.register("aec", PETTINGZOO_ID, "handover_marl.make:env")
    for name, agent in ((RECEIVER_ID, "receiver"), (GIVER_ID, "giver")):
        gymnasium.register(name, "handover_marl.views:SingleAgentEnv", kwargs={"agent": agent})
