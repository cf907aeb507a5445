"""Grasps of objects: known ones, their validation in simulation, and their selection."""
