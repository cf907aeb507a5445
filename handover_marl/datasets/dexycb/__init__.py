"""Import of raw DexYCB and MANO files into a data folder in HandoverSim's layout.

Every value equals the result of HandoverSim's conversion scripts bit for bit, on any machine: sums
whose rounding depends on the processor or on versions of NumPy and SciPy are written out in the
order and precision that made the official files.
"""
