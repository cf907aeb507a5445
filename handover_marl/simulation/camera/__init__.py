"""Simulated cameras: optics, noise, renderers and the ray caster."""
