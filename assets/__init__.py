"""Models, grasps and network weights that are part of the library."""
