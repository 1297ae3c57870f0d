"""The keys of transforms.json and of calibration.json (docs/dataset_format.md)."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
import torch
from torch import Tensor

from aenerf_ns.camera.image_encoding import ImageEncoding
from aenerf_ns.camera.intrinsics import CameraIntrinsics, Origin
from aenerf_ns.camera.trajectory import require_rigid
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.files.json_file import Nanoseconds, convert, read_json

_MOUNT = "T_frame_event"
# Other programs write the distortion or the model of a lens under these keys, which are not read.
_UNREAD_LENS = "dist(_|$)|(?!.*undistort).*distort|(is_)?fisheye$|lens_model"
# Each of these keys states a part of a lens, in this format or in another program's.
_LENS = {"camera_model", "k1", "k2", "k3", "k4", "p1", "p2", "fl_x", "fx", "K", "camera_matrix", "intrinsics"}
Vector = tuple[float, float, float]
Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]


class _Camera(msgspec.Struct, kw_only=True):
    """A camera by Nerfstudio's names of intrinsics, in pixels from the edge of the image."""

    width: int
    height: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    camera_model: str = "OPENCV"
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        parameters = self.intrinsics().to_transforms()
        for name in ("k3", "k4", "p1", "p2"):
            if (value := getattr(self, name)) and name not in parameters:
                raise ValueError(f"{name} is {value:g}, which camera_model {self.camera_model} does not have")

    def intrinsics(self) -> CameraIntrinsics:
        """Return the camera's lens."""
        return CameraIntrinsics.from_transforms(self.width, self.height, msgspec.structs.asdict(self))


class _Size(msgspec.Struct):
    """All that a file must state of an event camera whose lens is not known."""

    width: int
    height: int


class FrameCamera(_Camera, kw_only=True):
    """The camera that took the images, whose keys stand at the top of the file."""

    width: int = msgspec.field(name="w")
    height: int = msgspec.field(name="h")


class EventCamera(_Camera, kw_only=True):
    """The event camera and its sensor. ``T_frame_event`` takes points from its coordinates to the frame camera's."""

    file: str | None = None
    intrinsics_origin: Origin = "given"
    has_assumed_thresholds: bool = False
    positive_contrast_threshold: float | None = None
    negative_contrast_threshold: float | None = None
    refractory_period_ns: int = 0
    bandwidth_hz: float = 0.0
    bayer_pattern: str = ""
    T_frame_event: Matrix | None = None


class Frame(msgspec.Struct, kw_only=True):
    """An image. ``transform_matrix`` is camera-to-world with OpenGL camera axes."""

    file_path: str
    transform_matrix: Matrix | None = None
    timestamp: Nanoseconds | None = None


class Transforms(msgspec.Struct, kw_only=True):
    """The whole file, apart from the keys of :class:`FrameCamera`."""

    event_camera: EventCamera
    image_encoding: ImageEncoding = "srgb"
    frames: list[Frame] = []
    train_filenames: list[str] = []
    val_filenames: list[str] = []
    test_filenames: list[str] = []
    scene_box: tuple[Vector, Vector] | None = None
    max_pose_gap_ns: Annotated[int, msgspec.Meta(gt=0)] | None = None
    auto_scale_poses: bool = True

    def __post_init__(self) -> None:
        if self.scene_box is not None and not all(low < high for low, high in zip(*self.scene_box, strict=True)):
            raise ValueError(f"scene_box has corners {self.scene_box}, the first not below the second")


def read_transforms(path: Path, image_encoding: ImageEncoding = "srgb") -> tuple[Transforms, CameraIntrinsics]:
    """Read transforms.json or calibration.json, with the encoding of the images where the file states none.

    Returns:
        The file, and the lens of the camera that took the images: the event camera's where the file states no other. An
        event camera without any intrinsics has a guessed lens.

    Raises:
        DataError: the file is missing or malformed, or a value is impossible.
    """
    values = {"image_encoding": image_encoding, **read_json(path, dict)}
    camera = values.get("event_camera")
    parts = [part for part in (values, camera) if isinstance(part, dict)]
    for part in parts:
        known = {"is_fisheye"} if part.get("camera_model") == "OPENCV_FISHEYE" else set()
        if unread := [name for name in part if name not in known and part[name] and re.match(_UNREAD_LENS, name)]:
            remedy = "state camera_model, and k1, k2, p1, p2, k3 or for a fisheye (OPENCV_FISHEYE) k1 to k4"
            raise DataError(path, f"it states {unread[0]}, which is not read", remedy)
    stated = [name for part in parts for name in part if re.match("T_.*event", name) and name != _MOUNT]
    if stated and not (isinstance(camera, dict) and camera.get(_MOUNT) is not None):
        remedy = f"state {_MOUNT} in event_camera, which takes points from its coordinates to the frame camera's"
        raise DataError(path, f"it states {stated[0]}, which is not read", remedy)
    if isinstance(camera, dict) and camera.keys().isdisjoint(("fl_x", "fl_y", "cx", "cy")):
        # A lens at the top is the frame camera's only where a size stands beside it.
        if lens := sorted((camera if "w" in values else {**values, **camera}).keys() & _LENS):
            problem = f"it states {lens[0]}, but event_camera has no fl_x, fl_y, cx and cy"
            raise DataError(path, problem, f"state these too, or leave {lens[0]} out: all is then estimated")
        size = convert(path, camera, _Size, name="event_camera")
        with value_errors_as_data_error(path):
            guess = CameraIntrinsics.guess(size.width, size.height)
        values["event_camera"] = {**camera, **guess.to_transforms(), "intrinsics_origin": "guessed"}
    meta = convert(path, values, Transforms)
    if "w" not in values and not meta.frames:
        return meta, meta.event_camera.intrinsics()
    return meta, convert(path, values, FrameCamera).intrinsics()


def frame_from_event(path: Path, camera: EventCamera, frame_lens: CameraIntrinsics) -> Tensor:
    """Return the (4, 4) float64 motion from the event camera's to the frame camera's coordinates.

    Raises:
        DataError: it is missing, and the lenses say that these are two cameras; or it is no motion.
    """
    lens = camera.intrinsics()
    # The images may be undistorted ones of the same sensor.
    undistorted = replace(frame_lens, lens_model=lens.lens_model, distortion=lens.distortion)
    if camera.T_frame_event is None and undistorted == lens:
        return torch.eye(4, dtype=torch.float64)
    return rigid_motion(path, "event_camera.T_frame_event", camera.T_frame_event)


def rigid_motion(path: Path, name: str, matrix: Matrix | None) -> Tensor:
    """Return the (4, 4) float64 matrix that a file has under a name.

    Raises:
        DataError: it is missing, or not a rotation and a translation.
    """
    if matrix is None:
        remedy = "state how the one camera is mounted on the other (4 x 4); a beam splitter is the identity"
        raise DataError(path, f"{name} is missing", remedy)
    motion = torch.tensor(matrix, dtype=torch.float64)
    require_rigid(motion[None], f"{path}: {name}")
    return motion
