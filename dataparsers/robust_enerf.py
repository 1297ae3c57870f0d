"""The format of Robust e-NeRF (Low and Lee 2023): the output of ESIM in NumPy files, and posed views."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.events.sensor import BayerPattern, SensorModel
from aenerf_ns.files.event_arrays import POSITION_TIMESTAMP_POLARITY, ArrayEventFile, read_npz_member
from aenerf_ns.files.json_file import convert, read_json
from aenerf_ns.files.limits import file_inside
from aenerf_ns.files.transforms import Matrix, Vector, rigid_motion
from aenerf_ns.files.tum_trajectory import poses_from_quaternions
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.images import open_image
from aenerf_ns.recording.options import ObjectDataParserConfig
from aenerf_ns.recording.recording import Capture, Recording, ReferenceView, Split
from aenerf_ns.recording.views import IMAGE_SUFFIXES

# The authors' configuration: half the side of the box around the synthetic scenes.
_HALF_EXTENT = 1.5


Matrix3 = tuple[Vector, Vector, Vector]
# Limit on the numbers in an array of a calibration.
_MAX_VALUES = 100


class _Calibration(msgspec.Struct):
    """The arrays of camera_calibration.npz that are read."""

    intrinsics: Matrix3
    distortion_params: list[float]
    img_width: float
    img_height: float
    pos_contrast_threshold: float
    neg_contrast_threshold: float
    refractory_period: Annotated[float, msgspec.Meta(ge=0, le=1e12)]
    bayer_pattern: BayerPattern
    distortion_model: str = "none"


class _View(msgspec.Struct):
    file_path: str
    transform_matrix: Matrix


class _Views(msgspec.Struct):
    """A split of posed views. One camera took all of them: ``intrinsics``, or else a pinhole of ``camera_angle_x``."""

    frames: list[_View]
    camera_angle_x: Annotated[float, msgspec.Meta(gt=0, lt=math.pi)] | None = None
    intrinsics: Matrix3 | None = None


@dataclass
class RobustENeRFDataParserConfig(ObjectDataParserConfig):
    """Robust e-NeRF (raw_events.npz)."""

    markers = ("raw_events.npz", "camera_calibration.npz")
    _target: type = field(default_factory=lambda: RobustENeRFDataParser)
    auto_scale_poses: bool | None = True
    """Scale the estimated poses to fit in a box of +/- 1, where the scene has no box. The cameras of an object of 1.5
    units are further out, where the contraction of unbounded space would begin."""


class RobustENeRFDataParser(EventDataParser):
    """Read a scene of Robust e-NeRF. The folder ``views`` is in the scene's folder or one folder up."""

    config: RobustENeRFDataParserConfig

    def read_recording(self) -> Recording:
        capture, _ = self.read_capture()
        frame_camera, views = _read_views(self.data)
        # Only scenes simulated from Blender have this file.
        synthetic = (self.data / "renderer_params.npz").is_file()
        return self.config.make_recording(
            _read_poses(self.poses_path()),
            capture if frame_camera is None else replace(capture, frame_camera=frame_camera),
            reference_views={"train": [], **views},
            scene_box=self.config.scene_box(_HALF_EXTENT if synthetic else 0.0),
            image_background=(1.0, 1.0, 1.0),
        )

    def poses_path(self) -> Path:
        return self.data / "camera_poses.npz"

    def read_capture(self) -> tuple[Capture, list[tuple[int, Path]]]:
        camera, sensor = _read_calibration(self.data / "camera_calibration.npz")
        events = ArrayEventFile(self.data / "raw_events.npz", camera.width, camera.height, POSITION_TIMESTAMP_POLARITY)
        # The views have no times.
        return self.config.make_capture(sensor, event_file=events, event_camera=camera), []


def _read_calibration(path: Path) -> tuple[CameraIntrinsics, SensorModel]:
    values: dict[str, Any] = {}
    for name in _Calibration.__struct_fields__:
        if name == "distortion_model" and not values["distortion_params"]:
            continue
        array = read_npz_member(path, name)
        if array.size > _MAX_VALUES:
            raise DataError(path, f"{name} has shape {array.shape}", "store the calibration of one camera")
        values[name] = array.tolist()
    stated = convert(path, values, _Calibration)
    with value_errors_as_data_error(path):
        camera = CameraIntrinsics.from_opencv(
            (stated.img_width, stated.img_height),
            _pinhole(stated.intrinsics),
            stated.distortion_params,
            stated.distortion_model,
        )
        thresholds = stated.pos_contrast_threshold, stated.neg_contrast_threshold
        sensor = SensorModel(*thresholds, round(stated.refractory_period), stated.bayer_pattern)
    return camera, sensor


def _pinhole(matrix: Matrix3) -> tuple[float, float, float, float]:
    """Return fx, fy, cx and cy."""
    return matrix[0][0], matrix[1][1], matrix[0][2], matrix[1][2]


def _read_poses(path: Path) -> Trajectory:
    arrays = {name: read_npz_member(path, f"T_wc_{name}") for name in ("position", "orientation", "timestamp")}
    length = arrays["timestamp"].size
    expected = {"position": ((length, 3), "iuf"), "orientation": ((length, 4), "iuf"), "timestamp": ((length,), "iu")}
    for name, (shape, kinds) in expected.items():
        array = arrays[name]
        if array.shape != shape or array.dtype.kind not in kinds:
            remedy = f"it must hold {' x '.join(map(str, shape))} numbers, for {length} integer times in nanoseconds"
            raise DataError(path, f"T_wc_{name} has type {array.dtype} and shape {array.shape}", remedy)
    positions, quaternions, times = arrays.values()
    poses = poses_from_quaternions(path, positions.astype(np.float64), quaternions.astype(np.float64))
    return Trajectory(times.astype(np.int64), poses, path)


def _read_views(folder: Path) -> tuple[CameraIntrinsics | None, dict[Split, list[ReferenceView]]]:
    """Read the lens of the views, or None where there are no views, and the views of the val and the test split."""
    root = next((views for views in (folder / "views", folder.parent / "views") if views.is_dir()), folder / "views")
    camera: CameraIntrinsics | None = None
    splits: dict[Split, list[ReferenceView]] = {"val": [], "test": []}
    for split, views in splits.items():
        path = root / f"transforms_{split}.json"
        if not path.is_file():
            continue
        meta = read_json(path, _Views)
        views += [_read_view(path, f"frames[{index}]", view) for index, view in enumerate(meta.frames)]
        if views:
            own = _view_camera(path, meta, views[0].file)
            if camera not in (None, own):
                raise DataError(path, "its camera is not that of the other split", "give both splits one camera")
            camera = own
    return camera, splits


def _read_view(path: Path, key: str, view: _View) -> ReferenceView:
    # The dataset leaves the suffix out.
    inside = file_inside(path.parent, view.file_path, path)
    files = [inside.with_name(f"{inside.name}{suffix}") for suffix in ("", *IMAGE_SUFFIXES)]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise DataError(path, f"{key} names {view.file_path}, which is no PNG or JPEG image", "copy the images too")
    pose = rigid_motion(path, f"{key}.transform_matrix", view.transform_matrix)
    return ReferenceView(file, pose @ OPENCV_TO_OPENGL, None)


def _view_camera(path: Path, meta: _Views, image: Path) -> CameraIntrinsics:
    with open_image(image) as opened:
        width, height = opened.size
    with value_errors_as_data_error(path):
        if meta.camera_angle_x is not None:
            focal = width / 2 / math.tan(meta.camera_angle_x / 2)
            return CameraIntrinsics(width, height, focal, focal, width / 2, height / 2)
        if meta.intrinsics is None:
            raise DataError(path, "it has neither camera_angle_x nor intrinsics", "give one of them")
        return CameraIntrinsics.from_opencv((width, height), _pinhole(meta.intrinsics))
