"""Policies for the receiver, the robot side."""
