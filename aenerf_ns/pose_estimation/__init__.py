"""Poses of a recording from its frames: COLMAP's structure from motion, and frames of a video."""
