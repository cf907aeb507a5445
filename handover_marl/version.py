"""Version of the library."""

__version__ = "0.8.3"
