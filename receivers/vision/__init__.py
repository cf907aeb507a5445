"""Receiver `vision`, which uses only the point clouds of the wrist camera."""
