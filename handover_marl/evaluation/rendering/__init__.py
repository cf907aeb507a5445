"""Rendering of one scene: images, videos, replay pages, and plans."""
