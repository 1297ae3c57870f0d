"""The format of Robust e-NeRF (Low and Lee 2023): the output of ESIM in NumPy files, and posed views."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from numpy.typing import NDArray

from aenerf_ns.camera.intrinsics import CameraIntrinsics, LensModel
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_arrays import POSITION_TIMESTAMP_POLARITY, NpzEventFile, read_npz_member
from aenerf_ns.files.json_object import JsonObject
from aenerf_ns.files.tum_trajectory import poses_from_quaternions
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.images import image_size_and_mode
from aenerf_ns.recording.options import ObjectDataParserConfig
from aenerf_ns.recording.recording import Recording, ReferenceView, Split
from aenerf_ns.recording.views import IMAGE_SUFFIXES

# Half the side of the box around the synthetic scenes, in the authors' configuration.
_HALF_EXTENT = 1.5
_LENS_MODELS: dict[str, LensModel] = {"plumb_bob": "radial_tangential", "equidistant": "fisheye"}


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
        trajectory, ground_truth = self.config.estimated(_read_poses(folder / "camera_poses.npz"))
        frame_camera, views = _read_views(folder)
        # Only scenes simulated from Blender have this file.
        synthetic = (folder / "renderer_params.npz").is_file()
        return Recording(
            event_file=NpzEventFile(
                folder / "raw_events.npz", camera.width, camera.height, POSITION_TIMESTAMP_POLARITY
            ),
            event_camera=camera,
            sensor=self.config.sensor(stated),
            trajectory=trajectory,
            ground_truth=ground_truth,
            frame_camera=camera if frame_camera is None else frame_camera,
            reference_views={"train": [], **views},
            # The events were simulated from these values.
            image_encoding="linear",
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
    lens: LensModel = "radial_tangential"
    if distortion:
        model = _word(path, "distortion_model")
        if model not in _LENS_MODELS:
            raise DataError(path, f"distortion_model is {model!r}", f"use one of {', '.join(_LENS_MODELS)}")
        lens = _LENS_MODELS[model]
    # Four numbers are OpenCV's k1, k2, p1 and p2: k3 is zero.
    distortion += [0.0] * ((5 if lens == "radial_tangential" else 4) - len(distortion))
    single = {
        name: float(_numbers(path, name, ()))
        for name in ("img_width", "img_height", "pos_contrast_threshold", "neg_contrast_threshold", "refractory_period")
    }
    if not all(map(math.isfinite, single.values())):
        raise DataError(path, f"a value of {single} is not finite", "calibrate the camera")
    try:
        camera = CameraIntrinsics(
            single["img_width"],  # type: ignore[arg-type]
            single["img_height"],  # type: ignore[arg-type]
            float(matrix[0, 0]),
            float(matrix[1, 1]),
            float(matrix[0, 2]) + 0.5,
            float(matrix[1, 2]) + 0.5,
            lens,
            tuple(distortion),
        )
        sensor = SensorModel(
            single["pos_contrast_threshold"],
            single["neg_contrast_threshold"],
            round(single["refractory_period"]),
            _word(path, "bayer_pattern"),  # type: ignore[arg-type]
        )
    except DataError:
        raise
    except ValueError as error:
        raise DataError(path, str(error), "correct it there") from None
    return camera, sensor


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
    root = next((place for place in (folder / "views", folder.parent / "views") if place.is_dir()), None)
    camera, splits = None, {}
    for split in ("val", "test"):
        views: list[ReferenceView] = []
        path = folder if root is None else root / f"transforms_{split}.json"
        if path.is_file():
            meta = JsonObject.read(path)
            for index in range(len(meta.get("frames", list))):
                views.append(_read_view(meta.entry_block("frames", index)))
        if views:
            own = _view_camera(meta, views[0].file)
            if camera not in (None, own):
                raise DataError(path, "its camera is not that of the other split", "give both splits one camera")
            camera = own
        splits[split] = views
    return camera, splits  # type: ignore[return-value]


def _read_view(frame: JsonObject) -> ReferenceView:
    name = frame.get("file_path", str)
    # The dataset leaves the suffix out.
    inside = frame.file("file_path")
    files = [inside.with_name(f"{inside.name}{suffix}") for suffix in ("", *IMAGE_SUFFIXES)]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise frame.error("file_path", f"names {name}, which is no PNG or JPEG image")
    pose = frame.rigid_motion("transform_matrix")
    if pose is None:
        raise frame.error("transform_matrix", "is missing")
    return ReferenceView(file, pose @ OPENCV_TO_OPENGL, None)


def _view_camera(meta: JsonObject, image: Path) -> CameraIntrinsics:
    width, height = image_size_and_mode(image)[0]
    try:
        if "camera_angle_x" in meta:
            focal = width / 2 / math.tan(meta.get("camera_angle_x", float) / 2)
            return CameraIntrinsics(width, height, focal, focal, width / 2, height / 2)
        matrix = meta.numbers("intrinsics", meta.get("intrinsics", list), (3, 3)).tolist()
        return CameraIntrinsics(
            width, height, fx=matrix[0][0], fy=matrix[1][1], cx=matrix[0][2] + 0.5, cy=matrix[1][2] + 0.5
        )
    except DataError:
        raise
    except (ValueError, ZeroDivisionError) as error:
        raise meta.error("intrinsics:", str(error)) from None


robust_enerf_dataparser = DataParserSpecification(
    config=RobustENeRFDataParserConfig(), description="Robust e-NeRF: raw_events.npz, camera poses and calibration"
)
