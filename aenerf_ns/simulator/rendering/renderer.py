"""What the simulator asks of a scene: pictures through a pinhole camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

POINT_SPREAD = 0.5
"""Standard deviation of a pixel's Gaussian point-spread function, in pixels."""


class Renderer(Protocol):
    """A lit scene."""

    def render(
        self, camera_to_world: ArrayLike, intrinsics: Sequence[float], width: int, height: int, samples: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Picture through a pinhole camera.

        Args:
            camera_to_world: (4, 4) or (3, 4), OpenCV axes.
            intrinsics: (fx, fy, cx, cy) in pixels, pixel centres at +0.5.
            width, height: of the picture, in pixels.
            samples: rays per pixel, the same pattern of a Gaussian point-spread in every pixel and every frame: 1, or 3
                and more; one ray goes through the pixel's centre.

        Returns:
            radiance (H, W, 3) linear RGB; depth (H, W) along the optical axis, mean over the rays that hit, inf where
            none does; alpha (H, W), the fraction of rays that hit. All float32.

        Raises:
            ValueError: on a number of samples that `sample_offsets` has no pattern for.
        """
        ...


def sample_offsets(samples: int) -> NDArray[np.float64]:
    """Offsets (N, 2) in pixels of equally weighted rays that stand for the point-spread function.

    A spiral of golden angles with its radii at the quantiles of the Gaussian, then brought to exactly the Gaussian's
    mean and covariance. One ray goes through the centre.

    Raises:
        ValueError: on fewer than one ray, or on two, which cannot spread both ways.
    """
    if samples == 1:
        return np.zeros((1, 2))
    if samples < 3:
        raise ValueError(f"samples must be 1 or at least 3, got {samples}")
    rank = np.arange(samples)
    radius = np.sqrt(-2.0 * np.log(1.0 - (rank + 0.5) / samples))
    angle = np.pi * (3.0 - np.sqrt(5.0)) * rank
    offsets = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    offsets -= offsets.mean(axis=0)
    spread = np.linalg.cholesky(offsets.T @ offsets / samples)
    return np.ascontiguousarray(POINT_SPREAD * np.linalg.solve(spread, offsets.T).T)
