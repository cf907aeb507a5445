"""Generated handovers: as many scenes as wanted, each a pure function of its number and the data set's parameters."""
