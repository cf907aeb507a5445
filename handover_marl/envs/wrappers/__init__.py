"""Wrappers of the handover environment: control_agent and encode."""
