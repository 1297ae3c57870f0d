"""Bytes to events, poses and calibrations: a reader for each kind of file."""
