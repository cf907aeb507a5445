"""Networks on point clouds in plain PyTorch; importing this package does not import PyTorch."""
