"""Simulated worlds: what every engine has in common, and a room for each engine."""
