"""Robots, hands and objects as files describe them: poses, kinematics, shapes, meshes. No simulator in here."""
