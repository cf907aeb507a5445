"""Generated handovers: as many scenes as wanted, each a pure function of a seed and its number."""
