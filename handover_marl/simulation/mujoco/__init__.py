"""Simulation of handover scenes in MuJoCo, with cached models shared by all worlds of a process."""
