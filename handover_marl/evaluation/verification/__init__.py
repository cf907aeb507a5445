"""Verification of result folders: stored actions are simulated again, without the receiver's code."""
