"""Vector environments: many handover environments simulated together in one process."""
