"""Poses, kinematics, URDF models, meshes and distance fields, without a physics engine."""
