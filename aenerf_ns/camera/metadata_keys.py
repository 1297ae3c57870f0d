"""Keys in the metadata of rays and cameras that state their kind."""

from __future__ import annotations

CAMERA_DIRECTIONS = "camera_directions"
"""Only on rays that a supervision samples: (N, 3) float64 unit vectors in the camera's frame."""

REFERENCE_SECONDS = "reference_seconds"
"""On cameras that reference images were taken from: (N, 1) float64 seconds since the start of the estimated trajectory,
NaN for cameras off the trajectory."""

TRAJECTORY_SECONDS = "trajectory_seconds"
"""On cameras that lie on the estimated trajectory: (N, 1) float64 seconds since its start."""
