"""Metrics of fluency, safety and effort of an episode, computed from its motion trace."""
