"""Batches of worlds in MuJoCo Warp, on a GPU, or on the CPU in tests."""
