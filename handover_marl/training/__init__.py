"""What the training scripts share. Needs the extras `train` and `plot`."""
