"""Batches of episodes: state, giver motion and rules as arrays with the episode as first axis."""
