"""The two-agent environment, and wrappers around it."""
