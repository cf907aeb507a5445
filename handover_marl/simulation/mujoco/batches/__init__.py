"""Batches of MuJoCo worlds on a GPU, or on the CPU as a device, by MuJoCo Warp."""
