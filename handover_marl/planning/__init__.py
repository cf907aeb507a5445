"""Motion planning of a robot arm to grasps, collision avoidance, and motion prediction."""
