"""From raw DexYCB and MANO to the folder that HandoverSim reads."""
