"""Motion planning to a set of grasps: goal set, signed distances, goal selection, trajectory optimisation."""
