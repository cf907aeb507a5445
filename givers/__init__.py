"""Policies for the giver, the human side."""
