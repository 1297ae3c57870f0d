"""Cameras: where a pixel looks, and when."""
