"""Builders of grasps and of custom scenes; needs the extra `assets`."""
