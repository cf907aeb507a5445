"""Networks that see point clouds, in plain PyTorch; imported by who has it."""
