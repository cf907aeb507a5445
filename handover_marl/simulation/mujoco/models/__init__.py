"""MuJoCo models of handover scenes: shapes, bodies, sensors and variants."""
