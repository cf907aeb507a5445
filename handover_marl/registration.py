"""Names under which PettingZoo and Gymnasium find the environments."""

import pettingzoo
from gymnasium.envs.registration import register, registry

PETTINGZOO_ID = "HandoverMARL/Handover-v0"
RECEIVER_ID = "HandoverMARL/Receiver-v0"
GIVER_ID = "HandoverMARL/Giver-v0"


def register_environments() -> None:
    """Register the two-agent environment with PettingZoo and the single-agent views with Gymnasium.

    Gymnasium calls this itself in every process that imports it (entry point `gymnasium.envs`), so that vector
    environments find the views in their workers too.
    """
    if RECEIVER_ID in registry:
        return
    # Only views go to Gymnasium: its make() does not take a ParallelEnv.
    pettingzoo.register("parallel", PETTINGZOO_ID, "handover_marl.make:parallel_env")
    pettingzoo.register("aec", PETTINGZOO_ID, "handover_marl.make:env")
    for name, agent in ((RECEIVER_ID, "receiver"), (GIVER_ID, "giver")):
        register(name, "handover_marl.views:SingleAgentEnv", kwargs={"agent": agent})
