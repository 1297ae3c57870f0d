"""COLMAP's workspace, without running COLMAP."""

import numpy as np

from aenerf_ns.pose_estimation.colmap_workspace import _pixels_in_a_unit, pycolmap


def test_errors_are_in_pixels_of_any_lens() -> None:
    camera = pycolmap.Camera(model="OPENCV_FISHEYE", width=640, height=480, params=[300, 300, 320, 240, 0, 0, 0, 0])
    angles = np.array([0.01, 0.3, 0.9])
    pixels = np.stack([320 + 300 * angles, np.full(3, 240.0)], -1)
    # A fisheye's distance from the middle is the angle, and that in the plane is its tangent.
    expected = 300 * np.sqrt(np.cos(angles) ** 2 * angles / np.tan(angles))
    np.testing.assert_allclose(_pixels_in_a_unit(camera, pixels), expected, rtol=0.01)
    pinhole = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[300, 300, 320, 240])
    np.testing.assert_allclose(_pixels_in_a_unit(pinhole, pixels), 300, rtol=1e-9)
