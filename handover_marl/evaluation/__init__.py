"""Evaluation by HandoverSim's official protocol: simulation, result folders and reports."""
