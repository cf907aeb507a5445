"""HandoverSim's official protocol: running it, keeping results on disk, reporting them."""
