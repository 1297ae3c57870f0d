"""Poses of a recording from its frames or its events, or refined by them."""
