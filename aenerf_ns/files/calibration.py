"""The calibration of a recording: calibration.json, which has the names of transforms.json, or Kalibr's camchain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import torch
from torch import Tensor

from aenerf_ns.camera.image_encoding import ImageEncoding
from aenerf_ns.camera.intrinsics import CameraIntrinsics, Origin
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.events.sensor import SensorModel, sensor_values, states_thresholds
from aenerf_ns.files.json_file import convert
from aenerf_ns.files.kalibr import motion_between, read_camchain
from aenerf_ns.files.plain_yaml import read_plain_yaml
from aenerf_ns.files.transforms import frame_from_event, read_transforms


class _Values(msgspec.Struct):
    data: list[float]


class _CameraInfo(msgspec.Struct):
    image_width: int
    image_height: int
    camera_matrix: _Values
    distortion_coefficients: _Values
    distortion_model: str | None = None
    fisheye_model: int = 0
    binning_x: int = 0
    binning_y: int = 0
    roi: dict[str, Any] = {}


@dataclass(frozen=True)
class Calibration:
    """The lens and the sensor of the event camera, and the lens of the camera that took the images.

    ``frame_from_event`` (4, 4) float64 takes points from the event camera's to the frame camera's coordinates, OpenCV
    axes in both.
    """

    event_camera: CameraIntrinsics
    frame_camera: CameraIntrinsics
    frame_from_event: Tensor
    sensor: SensorModel = SensorModel()
    image_encoding: ImageEncoding = "linear"
    intrinsics_origin: Origin = "given"
    has_assumed_thresholds: bool = True


def read_calibration(
    path: Path, event_camera: str | None = None, frame_camera: str | None = None, has_images: bool = False
) -> Calibration:
    """Read calibration.json, the camchain that Kalibr writes, or the camera_info that ROS writes for one camera.

    Args:
        path: the file, which is JSON if its suffix is .json.
        event_camera: name of the event camera in a camchain. None: the only camera.
        frame_camera: name in the camchain of the camera that took the images. None: the event camera.
        has_images: whether there are images. Of several cameras, the one that took them must then be named.

    Raises:
        DataError: the file is missing or malformed, it holds several cameras and one that is needed is not named, or it
            has no camera of a name.
    """
    if path.suffix.lower() == ".json":
        require_no_names(path, event_camera, frame_camera)
        meta, lens = read_transforms(path, image_encoding="linear")
        with value_errors_as_data_error(path):
            sensor = SensorModel(**sensor_values(meta.event_camera))
        camera = meta.event_camera
        motion = frame_from_event(path, camera, lens)
        origin = camera.intrinsics_origin
        is_assumed = camera.has_assumed_thresholds or not states_thresholds(camera)
        return Calibration(camera.intrinsics(), lens, motion, sensor, meta.image_encoding, origin, is_assumed)
    content = read_plain_yaml(path)
    if isinstance(content, dict) and not content.keys().isdisjoint("Kk"):
        content = _as_file(content)
    if isinstance(content, dict) and "camera_matrix" in content:
        require_no_names(path, event_camera, frame_camera)
        lens = _camera_info(path, content)
        return Calibration(lens, lens, torch.eye(4, dtype=torch.float64))
    cameras = read_camchain(path)
    if len(cameras) > 1:
        for name, what, option in ((event_camera, "events", "event"), (frame_camera, "images", "frame")):
            if name is None and (what == "events" or has_images):
                remedy = f"name that of the {what} as --{option}-camera"
                raise DataError(path, f"its cameras are {', '.join(cameras)}", remedy)
    event_name = next(iter(cameras)) if event_camera is None else event_camera
    frame_name = event_name if frame_camera is None else frame_camera
    for name in (event_name, frame_name):
        if name not in cameras:
            raise DataError(path, f"it has no camera {name}", f"name one of {', '.join(cameras)}")
    motion = motion_between(path, cameras, event_name, frame_name)
    return Calibration(cameras[event_name].lens(), cameras[frame_name].lens(), motion)


def require_no_names(path: Path, *names: str | None) -> None:
    """Raise a DataError if a camera is named for a file in which cameras have no names."""
    for name in names:
        if name is not None:
            remedy = "give Kalibr's camchain, whose cameras have names, or name no camera"
            raise DataError(path, f"it has no camera {name}", remedy)


def _as_file(message: dict[str, Any]) -> dict[str, Any]:
    """Return a message camera_info of ROS 1 or 2 with the names of the file."""
    names = {"width": "image_width", "height": "image_height", "k": "camera_matrix", "d": "distortion_coefficients"}
    values = {name.lower(): value for name, value in message.items() if isinstance(name, str)}
    return {names.get(name, name): {"data": value} if name in ("k", "d") else value for name, value in values.items()}


def _camera_info(path: Path, content: dict[str, Any]) -> CameraIntrinsics:
    """Return the lens of ROS's camera_info, with the names of camera_calibration_parsers."""
    info = convert(path, content, _CameraInfo, "give the file that ROS's camera calibration wrote")
    if max(info.binning_x, info.binning_y) > 1 or info.roi.get("x_offset") or info.roi.get("y_offset"):
        problem = "its matrix is that of the whole sensor, but its pixels are binned or cropped"
        raise DataError(path, problem, "give size and matrix of the events' pixels, without binning and roi")
    matrix = info.camera_matrix.data
    with value_errors_as_data_error(path, "correct it there, or calibrate again with plumb_bob or equidistant"):
        if len(matrix) != 9:
            raise ValueError(f"its camera_matrix has {len(matrix)} numbers, not 9")
        pinhole = (matrix[0], matrix[4], matrix[2], matrix[5])
        size = (info.image_width, info.image_height)
        # OpenCV's own file names no model.
        model = info.distortion_model or ("equidistant" if info.fisheye_model else "plumb_bob")
        distortion = info.distortion_coefficients.data
        if model == "rational_polynomial" and not any(distortion[5:]):
            # Its denominator is 1.
            model, distortion = "plumb_bob", distortion[:5]
        return CameraIntrinsics.from_opencv(size, pinhole, distortion, model)
