"""Wrappers of the handover environment: freeze, encode, flatten."""
