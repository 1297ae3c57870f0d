"""The event sensor: streams, pairing, the sensor model and its simulation. NumPy and numba only."""
