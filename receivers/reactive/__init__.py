"""Receiver `reactive`, which uses the true poses of object and hand and moves with the person."""
