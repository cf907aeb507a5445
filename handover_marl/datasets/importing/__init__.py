"""From raw DexYCB and MANO, as their authors ship them, to the data folder in HandoverSim's layout.

Every value equals what HandoverSim's own conversion writes, to the bit, on any machine: sums whose rounding depends
on a processor or on a version of NumPy or SciPy are written out here in the order and precision that the original
had when the official data was made.
"""
