"""The receiver `vision`, which sees points alone. It is in `vision_receiver`."""
