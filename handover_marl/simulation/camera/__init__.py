"""Simulated wrist camera of the Panda: optics, noise, renderers and the ray caster."""
