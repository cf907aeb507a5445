"""Networks that see points, trained by imitation: one room for each receiver. Needs the extra `train`."""
