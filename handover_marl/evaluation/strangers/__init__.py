"""Evaluation of receivers and givers with partners that they have not met: populations, protocol and scores."""
