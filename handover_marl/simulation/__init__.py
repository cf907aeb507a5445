"""Physics simulation of handover scenes: common interfaces, PyBullet, MuJoCo, cameras."""
