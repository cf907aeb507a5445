"""Features of observations, and action schemes, which convert network outputs to actions."""
