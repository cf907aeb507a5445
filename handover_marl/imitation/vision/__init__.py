"""How the network of the receiver `vision` is trained: views of recorded moments, and grasps that are good there."""
