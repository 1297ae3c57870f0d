"""The format of PAEv3D (Wang et al. 2024): a matrix of events, and poses in VisionBlender's files."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, require_rigid
from aenerf_ns.dataparsers.eventnerf import UNIT_SPHERE, EvenPosesDataParserConfig, read_intrinsics
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_arrays import open_npz_member, read_npy_header
from aenerf_ns.files.event_hdf5 import TXYP_MATRIX, Hdf5TableFile
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.recording import Recording
from aenerf_ns.recording.views import MAX_VIEWS, image_files_of_poses, views_on_trajectory

_WIDTH, _HEIGHT = 640, 480
# The names that the pickles of NumPy's arrays and numbers hold. All others are refused: a pickle may run any code.
_KNOWN = {("_reconstruct", "multiarray"), ("scalar", "multiarray"), ("ndarray", "numpy"), ("dtype", "numpy")}
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
        data = Path(self.config.data)
        scenes = _scenes(data)
        if not scenes:
            raise DataError(data, "there is no H5_Files/SCENE", "give the dataset's folder, or H5_Files/SCENE in it")
        if len(scenes) > 1:
            raise DataError(data, f"it holds {len(scenes)} scenes", f"give one as --data, such as {scenes[0]}")
        scene, root = scenes[0], scenes[0].parents[1]
        camera = read_intrinsics(root / "Intrinsics", _WIDTH, _HEIGHT)
        event_file = Hdf5TableFile(scene / "event.h5", _WIDTH, _HEIGHT, TXYP_MATRIX, self.config.time_unit)
        folder = root / "Render_info" / scene.name
        files = sorted(folder.glob("*.npz"))
        if not files:
            raise DataError(folder, "it holds no .npz file", "copy the poses of the scene to it")
        poses = torch.stack([_camera_pose(file) for file in files])
        # The first pose is at the first event, the last pose at the last event.
        reference = self.config.spread(poses @ OPENCV_TO_OPENGL, event_file, folder)
        trajectory, ground_truth = self.config.estimated(reference)
        # There may be no images.
        images = zip(reference.times.tolist(), image_files_of_poses(folder, len(files)), strict=False)
        return Recording(
            event_file=event_file,
            event_camera=camera,
            sensor=self.config.sensor(SensorModel()),
            trajectory=trajectory,
            ground_truth=ground_truth,
            frame_camera=camera,
            reference_views=views_on_trajectory(list(images), reference),
            image_encoding="srgb",
            max_views=MAX_VIEWS,
            scene_box=self.config.scene_box(UNIT_SPHERE),
        )


def _scenes(data: Path) -> list[Path]:
    """List the folders of events. The event files may be missing, as where a trained run is opened."""
    if data.parent.name == "H5_Files":
        return [data]
    return sorted(path for path in data.glob("H5_Files/*") if path.is_dir())


class _Call:
    """A call that a pickle asks for, with its arguments and its state: noted, and not made."""

    def __init__(self, args: tuple) -> None:
        self.args = args
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


# In Python, because the unpickler in C reserves as much memory as a pickle asks for.
class _NotingUnpickler(pickle._Unpickler):
    """Read a pickle of NumPy's arrays, and call nothing that it names."""

    def find_class(self, module: str, name: str) -> Any:
        if (name, module.split(".")[-1]) not in _KNOWN or module.split(".")[0] != "numpy":
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return lambda *args: _Call(args)


def _objects(stream: IO[bytes]) -> list[dict]:
    """Return the dictionaries in a pickled array of objects."""
    array = _NotingUnpickler(stream).load()
    # The state of an array: version, shape, type, whether the order is Fortran's, and values.
    return [item for item in array.state[-1] if isinstance(item, dict)]


def _text(value: Any) -> str:
    """Return a text, which may be a scalar of NumPy: type and bytes."""
    if isinstance(value, _Call):
        dtype, content = value.args
        return str(np.frombuffer(content, dtype.args[0])[0])
    return str(value)


def _pose(value: Any) -> NDArray[np.float64] | None:
    """Return the (4, 4) matrix of numbers that a noted array stands for, or None if it is none."""
    if not isinstance(value, _Call) or not isinstance(value.state, tuple):
        return None
    _, shape, dtype, is_fortran, content = value.state
    kind = np.dtype(dtype.args[0])
    if shape != (4, 4) or kind.kind not in "iuf":
        return None
    values = np.frombuffer(content, kind.newbyteorder(dtype.state[1]))
    return values.reshape(4, 4, order="F" if is_fortran else "C").astype(np.float64)


def _camera_pose(path: Path) -> Tensor:
    """Read the camera's pose in VisionBlender's object_poses: (4, 4) float64, camera-to-world, OpenGL camera axes."""
    with open_npz_member(path, "object_poses") as (member, entry):
        if entry.file_size > _MAX_BYTES:
            raise ValueError(f"it has {entry.file_size:,} bytes")
        _, _, dtype = read_npy_header(member)
        objects = _objects(member) if dtype.hasobject else []
        camera = next((item for item in objects if _text(item.get("name")) == "Camera"), None)
        pose = None if camera is None else _pose(camera.get("pose"))
    if camera is None:
        raise DataError(path, "its object_poses hold no 'Camera'", "render it with VisionBlender again")
    if pose is None:
        raise DataError(path, "its camera's pose is not an array of 4 x 4 numbers", "copy it again")
    if not np.isfinite(pose).all():
        raise DataError(path, "its camera's pose is not finite", "drop it, and its image")
    matrix = torch.from_numpy(pose)
    require_rigid(matrix[None], path)
    return matrix


paev3d_dataparser = DataParserSpecification(
    config=PAEv3DDataParserConfig(), description="PAEv3D: H5_Files, Render_info and Intrinsics"
)
