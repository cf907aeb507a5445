"""Vector environments: many handover environments simulated in lockstep in one process."""
