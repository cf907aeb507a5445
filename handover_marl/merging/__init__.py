"""Putting the shards of a run together: the folder that one run would have written."""
