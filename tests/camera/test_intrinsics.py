"""Pixel directions against OpenCV's projection and against the framework's own rays."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL

DAVIS = CameraIntrinsics(
    240, 180, 335.42, 335.35, 130.42, 99.69, "radial_tangential", (-0.1386, 0.0934, -0.0034, 0.0017, 0.02)
)
FISHEYE = CameraIntrinsics(320, 240, 160.0, 161.0, 157.0, 122.0, "fisheye", (-0.022, -0.008, 0.003, -0.0006))
PINHOLE = CameraIntrinsics(5, 4, 6.0, 7.0, 2.5, 2.0)
# Its optical axis goes through a pixel's center, where the framework alone would have no direction.
CENTERED = replace(FISHEYE, cx=160.5, cy=120.5)
OF_EACH_LENS = pytest.mark.parametrize(
    "camera", [DAVIS, FISHEYE, CENTERED, PINHOLE], ids=["radial_tangential", "fisheye", "centered", "pinhole"]
)


@OF_EACH_LENS
def test_opencv_projects_directions_onto_pixels(camera: CameraIntrinsics) -> None:
    directions, has_direction = camera.pixel_directions()
    assert has_direction.all()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-15)
    points = (directions * [1, -1, -1]).reshape(-1, 1, 3) * 3.7
    project = cv2.fisheye.projectPoints if camera.lens_model == "fisheye" else cv2.projectPoints
    # OpenCV counts from the center of the first pixel.
    matrix = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    pixels, _ = project(points, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion))
    pixels = pixels.reshape(-1, 2)
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    np.testing.assert_allclose(pixels, np.stack([columns, rows], -1).reshape(-1, 2), atol=1e-8)


@OF_EACH_LENS
def test_nerfstudio_has_the_same_rays(camera: CameraIntrinsics) -> None:
    pose = (torch.eye(4, dtype=torch.float64) @ OPENCV_TO_OPENGL)[None, :3]
    pose[0, :, 3] = torch.tensor([1.0, 2.0, 3.0])
    rays = camera.cameras(pose).generate_rays(camera_indices=0)
    directions, _ = camera.pixel_directions()
    expected = directions @ pose[0, :, :3].numpy().T
    np.testing.assert_allclose(rays.directions.numpy(), expected, atol=2e-5)
    assert torch.equal(rays.origins[0, 0], torch.tensor([1.0, 2.0, 3.0]))
    assert rays.directions.dtype == torch.float32


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": -1}, "width must be a whole number from 1 to 16384, not -1"),
        ({"cx": float("nan")}, "cx must be from"),
        ({"lens_model": "kb4"}, "lens_model must be one of"),
    ],
)
def test_impossible_cameras_are_refused(change: dict, message: str) -> None:
    values = {"width": 4, "height": 3, "fx": 1.0, "fy": 1.0, "cx": 2.0, "cy": 1.5}
    with pytest.raises(ValueError, match=message):
        CameraIntrinsics(**{**values, **change})
