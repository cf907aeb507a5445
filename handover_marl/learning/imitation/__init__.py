"""Imitation learning of the networks that the receivers `gaddpg` and `vision` use."""
