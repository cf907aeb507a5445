"""The generators of the shipped models; needs the extra `assets`."""
