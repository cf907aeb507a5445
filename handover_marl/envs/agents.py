"""Names of the environment's agents."""

GIVER, RECEIVER = "giver", "receiver"
AGENTS = (GIVER, RECEIVER)
