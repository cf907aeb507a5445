"""Imitation learning of the network of the receiver `gaddpg` from a planning expert."""
