"""Building blocks of the training scripts: arguments, environments, run folders, evaluation."""
