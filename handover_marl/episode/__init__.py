"""Episodes of a handover: loop, giver motion, observations, referee, callbacks and metrics."""
