"""PyBullet worlds, bodies, rendering, inverse kinematics and queries."""
