"""A camera's lens: the direction in which each pixel looks, and the same lens in the terms of other programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
from nerfstudio.cameras.camera_utils import get_distortion_params
from nerfstudio.cameras.cameras import Cameras, CameraType
from numpy.typing import NDArray
from torch import Tensor

LensModel = Literal["radial_tangential", "fisheye"]

Origin = Literal["given", "estimated", "guessed"]
"""Where intrinsics come from."""

# The parameters of each lens model, in OpenCV's order.
_PARAMETERS: dict[LensModel, tuple[str, ...]] = {
    "radial_tangential": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
# What other programs call the two models.
_LENS_MODELS: dict[str, LensModel] = {
    # Nerfstudio and COLMAP.
    "OPENCV": "radial_tangential",
    "OPENCV_FISHEYE": "fisheye",
    # ROS and Kalibr.
    "plumb_bob": "radial_tangential",
    "radtan": "radial_tangential",
    "none": "radial_tangential",
    "equidistant": "fisheye",
    # Basalt.
    "kb4": "fisheye",
}

# A pixel whose undistorted direction projects back this far off, in pixels, lies where the lens model folds over.
_MAX_ROUND_TRIP_ERROR = 1e-3

# Nerfstudio's fisheye divides zero by zero at a pixel whose center is this close to the principal point, in pixels.
_MIN_FROM_CENTER = 1e-3

# 8K film cameras have 33 million pixels.
_MAX_SIDE, _MAX_PIXELS = 1 << 14, 1 << 25
_LIMITS = {"fx": (1e-2, 1e6), "fy": (1e-2, 1e6), "cx": (-1e6, 1e6), "cy": (-1e6, 1e6)}
# Pixels along each side that :meth:`CameraIntrinsics.has_valid_pixels` looks at.
_SAMPLES = 24


@dataclass(frozen=True)
class CameraIntrinsics:
    """Intrinsics and distortion of a camera.

    Attributes:
        width: number of pixel columns.
        height: number of pixel rows.
        fx: focal length along the rows, in pixels.
        fy: focal length along the columns, in pixels.
        cx: principal point from the left edge of the image, in pixels. The center of the first pixel is at 0.5
            (Nerfstudio's convention). OpenCV, Kalibr and ESIM count from that center: add 0.5 to their values.
        cy: principal point from the top edge of the image, in pixels, with the same convention.
        lens_model: "radial_tangential" (OpenCV's Brown-Conrady, "plumb_bob") or "fisheye" (OpenCV's fisheye,
            Kannala-Brandt, "equidistant", "kb4").
        distortion: in OpenCV's order: k1, k2, p1, p2, k3 ("radial_tangential") or k1, k2, k3, k4 ("fisheye").

    Raises:
        ValueError: a size is not a whole number of pixels or too large, a focal length or the principal point is not
            one that a camera can have, a value is not finite, or the number of distortion parameters does not fit the
            model.

    Example:
        >>> camera = CameraIntrinsics(width=346, height=260, fx=330.0, fy=330.0, cx=172.5, cy=129.5)
        >>> directions, is_valid = camera.pixel_directions()
        >>> directions.shape
        (260, 346, 3)
        >>> directions[129, 172]  # the principal point is the center of this pixel
        array([ 0., -0., -1.])
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens_model: LensModel = "radial_tangential"
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if not 0 < size <= _MAX_SIDE or size != int(size):
                raise ValueError(f"{name} must be a whole number from 1 to {_MAX_SIDE}, not {size:.12g}")
            # Some formats store it as a decimal number.
            object.__setattr__(self, name, int(size))
        if self.width * self.height > _MAX_PIXELS:
            raise ValueError(f"{self.width} x {self.height} pixels are more than {_MAX_PIXELS:,}")
        for name, (low, high) in _LIMITS.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be from {low:g} to {high:g} pixels, not {getattr(self, name):g}")
        if not np.isfinite(self.distortion).all():
            raise ValueError("the distortion must be finite")
        if self.lens_model not in _PARAMETERS:
            raise ValueError(f'lens_model must be one of {sorted(_PARAMETERS)}, not "{self.lens_model}"')
        expected = len(_PARAMETERS[self.lens_model])
        if len(self.distortion) != expected:
            raise ValueError(f"{self.lens_model} distortion takes {expected} numbers, not {len(self.distortion)}")

    @classmethod
    def guess(cls, width: int, height: int) -> CameraIntrinsics:
        """Make a camera whose lens is not known, with COLMAP's first guess of the focal length."""
        focal_length = 1.2 * max(width, height)
        return cls(width, height, focal_length, focal_length, width / 2, height / 2)

    @classmethod
    def from_opencv(
        cls,
        size: tuple[float, float],
        pinhole: tuple[float, float, float, float],
        distortion: Sequence[float] = (),
        lens_model: str = "plumb_bob",
    ) -> CameraIntrinsics:
        """Make a camera whose principal point is counted from the center of the first pixel.

        OpenCV, ROS, Kalibr, Basalt and ESIM count in this way.

        Args:
            size: width and height in pixels.
            pinhole: fx, fy, cx and cy in pixels.
            distortion: in OpenCV's order. What is missing at the end is zero.
            lens_model: the name that ROS, Kalibr or Basalt gives the model.

        Raises:
            ValueError: the lens model is unknown, or a value is none that a camera can have.
        """
        fx, fy, cx, cy = pinhole
        lens = _require_lens_model(lens_model)
        missing = len(_PARAMETERS[lens]) - len(distortion)
        return cls(*size, fx, fy, cx + 0.5, cy + 0.5, lens, (*distortion, *[0.0] * missing))  # type: ignore[arg-type]

    @classmethod
    def from_transforms(cls, width: int, height: int, values: Mapping[str, Any]) -> CameraIntrinsics:
        """Make a camera of Nerfstudio's names: fl_x, fl_y, cx, cy, camera_model, and the distortion parameters.

        Raises:
            ValueError: the camera model is unknown, or a value is none that a camera can have.
        """
        lens = _require_lens_model(values["camera_model"])
        distortion = tuple(values[name] for name in _PARAMETERS[lens])
        return cls(width, height, values["fl_x"], values["fl_y"], values["cx"], values["cy"], lens, distortion)

    def to_transforms(self) -> dict[str, Any]:
        """Return the lens by Nerfstudio's names, the inverse of :meth:`from_transforms` without the size."""
        return {
            "camera_model": "OPENCV_FISHEYE" if self.lens_model == "fisheye" else "OPENCV",
            "fl_x": self.fx,
            "fl_y": self.fy,
            "cx": self.cx,
            "cy": self.cy,
            **self._named_distortion,
        }

    def summary(self) -> str:
        """Return focal length and distortion for people to read."""
        distortion = ", ".join(f"{name} {value:.3g}" for name, value in self._named_distortion.items() if value)
        return f"focal length {self.fx:.1f} px, {distortion or 'no distortion'}"

    def to_colmap(self) -> tuple[str, list[float]]:
        """Return COLMAP's simplest model of the lens, and its parameters. Its pixels count from the edge, too."""
        pinhole = [float(value) for value in (self.fx, self.fy, self.cx, self.cy)]
        distortion = [float(value) for value in self.distortion]
        if self.lens_model == "fisheye":
            return "OPENCV_FISHEYE", pinhole + distortion
        if not any(distortion):
            return "PINHOLE", pinhole
        if distortion[4] == 0:
            return "OPENCV", pinhole + distortion[:4]
        # The last three are those of a denominator.
        return "FULL_OPENCV", [*pinhole, *distortion, 0.0, 0.0, 0.0]

    @property
    def _named_distortion(self) -> dict[str, float]:
        return dict(zip(_PARAMETERS[self.lens_model], self.distortion, strict=True))

    def pixel_directions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the directions through the pixel centers, undistorted to the last digit.

        Returns:
            (height, width, 3) float64 unit vectors in the camera's frame with Nerfstudio's axes (x right, y up,
            z backward), and (height, width) whether the pixel has a direction. A pixel beyond the range in which the
            distortion model can be inverted has none.
        """
        return self._directions(np.arange(self.width), np.arange(self.height))

    def has_valid_pixels(self) -> bool:
        """Return whether the distortion can be inverted at any of 24 x 24 sample pixels."""
        columns, rows = (
            np.linspace(0, side - 1, min(side, _SAMPLES)).astype(int) for side in (self.width, self.height)
        )
        return bool(self._directions(columns, rows)[1].any())

    def _directions(
        self, columns: NDArray[np.integer], rows: NDArray[np.integer]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the directions through the pixels of (W,) columns and (H,) rows, as :meth:`pixel_directions` does."""
        shape = len(rows), len(columns)
        columns, rows = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
        pixels = np.stack([columns, rows], -1).reshape(-1, 1, 2)
        # OpenCV counts from the center of the first pixel.
        matrix = np.array([[self.fx, 0, self.cx - 0.5], [0, self.fy, self.cy - 0.5], [0, 0, 1.0]])
        distortion = np.array(self.distortion)
        if self.lens_model == "fisheye":
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
            plane = cv2.fisheye.undistortPoints(pixels, matrix, distortion, criteria=criteria)
            projected = cv2.fisheye.distortPoints(plane, matrix, distortion)
        else:
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
            plane = cv2.undistortPointsIter(pixels, matrix, distortion, np.eye(3), np.eye(3), criteria)
            points = np.concatenate([plane, np.ones_like(plane[..., :1])], -1)
            projected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0]
        plane = plane.reshape(*shape, 2)
        directions = np.stack([plane[..., 0], -plane[..., 1], np.full(plane.shape[:2], -1.0)], -1)
        # A distortion that is absurd leaves points that are infinite. Such a pixel has no direction.
        with np.errstate(over="ignore", invalid="ignore"):
            error = np.linalg.norm(projected - pixels, axis=-1).reshape(shape)
            directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return directions, error < _MAX_ROUND_TRIP_ERROR

    def crop(self, x: int, y: int, width: int, height: int) -> CameraIntrinsics:
        """Return the camera of the part of the sensor that begins at pixel (x, y) and has the given size in pixels."""
        return replace(self, width=width, height=height, cx=self.cx - x, cy=self.cy - y)

    def scaled(self, factor: float) -> CameraIntrinsics:
        """Return the camera of smaller pictures, whose sides are a factor times as long, rounded down."""
        width, height, fx, fy, cx, cy = (factor * getattr(self, name) for name in ("width", "height", *_LIMITS))
        return replace(self, width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy)

    def cameras(self, camera_to_worlds: Tensor) -> Cameras:
        """Return Nerfstudio's cameras with this lens. A fisheye's axis through a pixel's center moves by 0.001 pixels.

        Args:
            camera_to_worlds: (N, 3, 4) poses, OpenGL camera axes.
        """
        fisheye, center = self.lens_model == "fisheye", np.floor([self.cx, self.cy]) + 0.5
        on_axis = fisheye and (np.abs(center - [self.cx, self.cy]) < _MIN_FROM_CENTER).all()
        return Cameras(
            camera_to_worlds=camera_to_worlds.float(),
            fx=self.fx,
            fy=self.fy,
            cx=float(center[0]) + _MIN_FROM_CENTER if on_axis else self.cx,
            cy=self.cy,
            width=self.width,
            height=self.height,
            distortion_params=get_distortion_params(**self._named_distortion) if any(self.distortion) else None,
            camera_type=CameraType.FISHEYE if fisheye else CameraType.PERSPECTIVE,
            # Nerfstudio's renderers write into it.
            metadata={},
        )


def _require_lens_model(name: str) -> LensModel:
    if name not in _LENS_MODELS:
        raise ValueError(f"the lens model is {name!r}, not one of {', '.join(_LENS_MODELS)}")
    return _LENS_MODELS[name]
