"""Training data and training of the grasp network of the receiver `vision`."""
