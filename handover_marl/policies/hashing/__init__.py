"""Hashes of policies: of their source code, of functions, and of the state of constructed policies."""
