"""One handover as it is played: the giver's motion, what agents see and do, the loop, and what is noted."""
