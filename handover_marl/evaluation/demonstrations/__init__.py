"""Data sets of episodes for imitation learning: recording, Minari's file layout, and reading."""
