"""The format of Robust e-NeRF (Low and Lee 2023): the output of ESIM in NumPy files, and posed views."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from numpy.typing import NDArray

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_arrays import POSITION_TIMESTAMP_POLARITY, NpzEventFile, read_npz_member
from aenerf_ns.files.json_file import read_json
from aenerf_ns.files.limits import file_inside
from aenerf_ns.files.transforms import Matrix, Vector, rigid_motion
from aenerf_ns.files.tum_trajectory import poses_from_quaternions
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.images import image_size_and_mode
from aenerf_ns.recording.options import ObjectDataParserConfig
from aenerf_ns.recording.recording import Recording, ReferenceView, Split
from aenerf_ns.recording.views import IMAGE_SUFFIXES

# Half the side of the box around the synthetic scenes, in the authors' configuration.
_HALF_EXTENT = 1.5


class _View(msgspec.Struct):
    file_path: str
    transform_matrix: Matrix


class _Views(msgspec.Struct):
    """A split of posed views. One camera took all of them: ``intrinsics``, or else a pinhole of ``camera_angle_x``."""

    frames: list[_View]
    camera_angle_x: Annotated[float, msgspec.Meta(gt=0, lt=math.pi)] | None = None
    intrinsics: tuple[Vector, Vector, Vector] | None = None


@dataclass
class RobustENeRFDataParserConfig(ObjectDataParserConfig):
    """Robust e-NeRF (raw_events.npz)."""

    markers = ("raw_events.npz", "camera_poses.npz", "camera_calibration.npz")
    _target: type = field(default_factory=lambda: RobustENeRFDataParser)
    auto_scale_poses: bool | None = True
    """Scale the estimated poses to fit in a box of +/- 1, where the scene has no box. The cameras of an object of 1.5
    units are further out, where the contraction of unbounded space would begin."""


class RobustENeRFDataParser(EventDataParser):
    """Read a scene of Robust e-NeRF. The folder ``views`` is in the scene's folder or one folder up."""

    config: RobustENeRFDataParserConfig

    def read_recording(self) -> Recording:
        folder = Path(self.config.data)
        camera, stated = _read_calibration(folder / "camera_calibration.npz")
        frame_camera, views = _read_views(folder)
        # Only scenes simulated from Blender have this file.
        synthetic = (folder / "renderer_params.npz").is_file()
        return self.config.make_recording(
            _read_poses(folder / "camera_poses.npz"),
            stated,
            event_file=NpzEventFile(
                folder / "raw_events.npz", camera.width, camera.height, POSITION_TIMESTAMP_POLARITY
            ),
            event_camera=camera,
            frame_camera=camera if frame_camera is None else frame_camera,
            reference_views={"train": [], **views},
            scene_box=self.config.scene_box(_HALF_EXTENT if synthetic else 0.0),
            image_background=(1.0, 1.0, 1.0),
        )


def _numbers(path: Path, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the array ``name`` as float64. It must hold numbers and have ``shape``, in which -1 means any size."""
    array = read_npz_member(path, name)
    fitting = tuple(size if wanted < 0 else wanted for size, wanted in zip(array.shape, shape, strict=False))
    if array.dtype.kind not in "iufb" or array.shape != fitting or array.ndim != len(shape):
        raise DataError(
            path,
            f"{name} has type {array.dtype} and shape {array.shape}",
            f"store {' x '.join('N' if size < 0 else str(size) for size in shape) or 'one'} number(s)",
        )
    return array.astype(np.float64)


def _word(path: Path, name: str) -> str:
    array = read_npz_member(path, name)
    if array.dtype.kind != "U" or array.shape:
        raise DataError(path, f"{name} has type {array.dtype} and shape {array.shape}", "store one string")
    return str(array)


def _read_calibration(path: Path) -> tuple[CameraIntrinsics, SensorModel]:
    matrix = _numbers(path, "intrinsics", (3, 3))
    distortion = _numbers(path, "distortion_params", (-1,)).tolist()
    single = {
        name: float(_numbers(path, name, ()))
        for name in ("img_width", "img_height", "pos_contrast_threshold", "neg_contrast_threshold", "refractory_period")
    }
    if not all(map(math.isfinite, single.values())):
        raise DataError(path, f"a value of {single} is not finite", "calibrate the camera")
    with value_errors_as_data_error(path):
        camera = CameraIntrinsics.from_opencv(
            (single["img_width"], single["img_height"]),
            _pinhole(matrix),
            distortion,
            _word(path, "distortion_model") if distortion else "none",
        )
        sensor = SensorModel(
            single["pos_contrast_threshold"],
            single["neg_contrast_threshold"],
            round(single["refractory_period"]),
            _word(path, "bayer_pattern"),  # type: ignore[arg-type]
        )
    return camera, sensor


def _pinhole(matrix: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return fx, fy, cx and cy of a (3, 3) matrix."""
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _read_poses(path: Path) -> Trajectory:
    positions = _numbers(path, "T_wc_position", (-1, 3))
    quaternions = _numbers(path, "T_wc_orientation", (-1, 4))
    times = read_npz_member(path, "T_wc_timestamp")
    if times.dtype.kind not in "iu" or times.ndim != 1:
        raise DataError(path, f"T_wc_timestamp has type {times.dtype} and shape {times.shape}", "store nanoseconds")
    if not len(positions) == len(quaternions) == len(times):
        raise DataError(
            path,
            f"it has {len(positions)} positions, {len(quaternions)} orientations and {len(times)} times",
            "store as many of each",
        )
    return Trajectory(times.astype(np.int64), poses_from_quaternions(path, positions, quaternions), path)


def _read_views(folder: Path) -> tuple[CameraIntrinsics | None, dict[Split, list[ReferenceView]]]:
    """Read the lens of the views, or None where there are no views, and the views of the val and the test split."""
    root = next((views for views in (folder / "views", folder.parent / "views") if views.is_dir()), None)
    camera: CameraIntrinsics | None = None
    splits: dict[Split, list[ReferenceView]] = {"val": [], "test": []}
    for split, views in splits.items():
        path = folder if root is None else root / f"transforms_{split}.json"
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
    width, height = image_size_and_mode(image)[0]
    with value_errors_as_data_error(path):
        if meta.camera_angle_x is not None:
            focal = width / 2 / math.tan(meta.camera_angle_x / 2)
            return CameraIntrinsics(width, height, focal, focal, width / 2, height / 2)
        if meta.intrinsics is None:
            raise DataError(path, "it has neither camera_angle_x nor intrinsics", "give one of them")
        return CameraIntrinsics.from_opencv((width, height), _pinhole(np.array(meta.intrinsics)))


robust_enerf_dataparser = DataParserSpecification(
    config=RobustENeRFDataParserConfig(), description="Robust e-NeRF: raw_events.npz, camera poses and calibration"
)
