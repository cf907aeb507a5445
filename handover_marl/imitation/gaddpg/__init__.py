"""How the network of the receiver `gaddpg` is trained: plans on static objects, imitation, DAgger."""
