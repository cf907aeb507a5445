"""Data sets of episodes for imitation learning: recording, reading, and conversion for Minari and LeRobot."""
