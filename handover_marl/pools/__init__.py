"""Work in several processes: in those of this machine, or on the nodes of a Ray cluster."""
