"""The simulated world. The only room that touches PyBullet."""
