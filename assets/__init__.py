"""Models the library makes itself."""
