"""Vector environments: many handover environments simulated together."""
