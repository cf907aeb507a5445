"""The version, readable without importing the library."""

__version__ = "0.6.0"
