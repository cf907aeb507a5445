"""Evaluation of receivers and givers with unseen partners: populations, protocol and scores."""
