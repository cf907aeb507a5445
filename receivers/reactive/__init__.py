"""The receiver `reactive`, which knows true poses and moves with the person. It is in `reactive_receiver`."""
