"""The worlds in PyBullet: exact and fast."""
