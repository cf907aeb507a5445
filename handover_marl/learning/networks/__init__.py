"""Networks on point clouds and images in plain PyTorch; importing this package does not import PyTorch."""
