"""Receiver `vision`, which perceives object and hand only by the wrist camera."""
