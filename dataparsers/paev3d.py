"""The format of PAEv3D (Wang et al. 2024): a matrix of events, and poses in VisionBlender's files."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, require_rigid
from aenerf_ns.dataparsers.eventnerf import EvenPosesDataParserConfig, read_intrinsics
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_arrays import open_npz_member, read_npy_header
from aenerf_ns.files.event_hdf5 import TXYP_MATRIX, Hdf5TableFile
from aenerf_ns.files.limits import list_files, require_one
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.recording import Capture, Recording

_WIDTH, _HEIGHT = 640, 480
# The file of a frame names some hundred objects at most.
_MAX_BYTES = 1 << 20


@dataclass
class PAEv3DDataParserConfig(EvenPosesDataParserConfig):
    """PAEv3D."""

    markers = ("H5_Files/SCENE/event.h5", "Render_info/SCENE", "Intrinsics")
    _target: type = field(default_factory=lambda: PAEv3DDataParser)

    @classmethod
    def recognizes(cls, data: Path) -> bool:
        return bool(_scenes(data))


class PAEv3DDataParser(EventDataParser):
    """Read a scene, given the folder of its events, or the dataset's folder where that holds one scene only."""

    config: PAEv3DDataParserConfig

    def read_recording(self) -> Recording:
        capture, _ = self.read_capture()
        folder = self.poses_path()
        poses = torch.stack([_read_camera_pose(file) for file in list_files(folder, "*.npz")])
        # The first pose is at the first event, the last pose at the last event.
        return self.config.make_even_recording(capture, poses @ OPENCV_TO_OPENGL, folder, folder)

    def poses_path(self) -> Path:
        scene = self._scene()
        return scene.parents[1] / "Render_info" / scene.name

    def read_capture(self) -> tuple[Capture, list[tuple[int, Path]]]:
        scene = self._scene()
        capture = self.config.make_capture(
            SensorModel(),
            has_assumed_thresholds=True,
            event_file=Hdf5TableFile(scene / "event.h5", _WIDTH, _HEIGHT, TXYP_MATRIX, self.config.time_unit),
            event_camera=read_intrinsics(scene.parents[1] / "Intrinsics", _WIDTH, _HEIGHT),
            image_encoding="srgb",
        )
        # The images have no times but those of the poses.
        return capture, []

    def _scene(self) -> Path:
        return require_one(_scenes(self.data), self.data, "scenes (H5_Files/SCENE)", "give the folder of one as --data")


def _scenes(data: Path) -> list[Path]:
    """List the folders of events. The event files may be missing, as where a trained run is opened."""
    if data.parent.name == "H5_Files":
        return [data]
    return sorted(path for path in data.glob("H5_Files/*") if path.is_dir())


class _Type:
    """A dtype in a pickle."""

    def __init__(self, code: str, *_: object) -> None:
        self.dtype = np.dtype(code)

    def __setstate__(self, state: tuple) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """An array in a pickle: its objects as a list, or its numbers as NumPy's array of them."""

    values: Any = None

    def __init__(self, *_: object) -> None:
        pass

    def __setstate__(self, state: tuple) -> None:
        _, shape, of, is_fortran, content = state
        if isinstance(content, list):
            self.values = content
        else:
            self.values = np.frombuffer(content, of.dtype).reshape(shape, order="F" if is_fortran else "C")


def _scalar(of: _Type, content: bytes) -> str:
    return str(np.frombuffer(content, of.dtype)[0])


# Names in the pickles of NumPy's arrays and numbers.
_STAND_INS = {"dtype": _Type, "_reconstruct": _Array, "scalar": _scalar, "ndarray": _Array}


# This is the unpickler in Python, because the one in C reserves as much memory as a pickle asks for.
class _ArrayUnpickler(pickle._Unpickler):
    """Read NumPy's arrays without NumPy's own functions. Refuse all other calls: a pickle may run any code."""

    def find_class(self, module: str, name: str) -> Any:
        if module.split(".")[0] != "numpy" or name not in _STAND_INS:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return _STAND_INS[name]


def _read_camera_pose(path: Path) -> Tensor:
    """Read the camera's pose in VisionBlender's object_poses: (4, 4) float64, camera-to-world, OpenGL camera axes."""
    with open_npz_member(path, "object_poses") as (member, entry):
        if entry.file_size > _MAX_BYTES:
            raise ValueError(f"it has {entry.file_size:,} bytes")
        read_npy_header(member)
        objects = [item for item in _ArrayUnpickler(member).load().values if isinstance(item, dict)]
        camera = next((item for item in objects if item.get("name") == "Camera"), {})
        pose = getattr(camera.get("pose"), "values", None)
        if not isinstance(pose, np.ndarray) or pose.shape != (4, 4) or pose.dtype.kind not in "iuf":
            raise ValueError("it holds no 'Camera' with a pose of 4 x 4 numbers")
        matrix = torch.from_numpy(pose.astype(np.float64))
    require_rigid(matrix[None], path)
    return matrix
