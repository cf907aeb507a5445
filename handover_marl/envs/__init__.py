"""Two-agent handover environment, its rewards, wrappers and vector environments."""
