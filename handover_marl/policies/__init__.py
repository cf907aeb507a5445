"""Policies: base classes, references by name, and hashes of their code."""
