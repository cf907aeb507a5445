"""Receiver `reactive`, which follows the object that the person moves, by the true poses of object and hand."""
