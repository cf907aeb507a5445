"""Batches of MuJoCo worlds: on processor threads with MuJoCo, or on a GPU with MuJoCo Warp."""
