"""The wrist camera's pictures by casting rays at models: from joints alone, without a physics engine."""
