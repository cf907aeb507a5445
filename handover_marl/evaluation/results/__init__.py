"""Results of evaluations, and their folders on disk."""
