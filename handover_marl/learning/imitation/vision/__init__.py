"""Training data and training of the two networks of the receiver `vision`: grasp prediction and segmentation."""
