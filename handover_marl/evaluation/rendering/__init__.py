"""Rendering of one scene: images, films, replay pages, and plans."""
