"""The format of PAEv3D (Wang et al. 2024): a matrix of events, and poses in VisionBlender's files."""

from __future__ import annotations

import pickle
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from torch import Tensor

from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, require_rigid
from aenerf_ns.dataparsers.eventnerf import UNIT_SPHERE, EvenPosesDataParserConfig, read_intrinsics
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_arrays import NPZ_ERRORS, read_npy_header
from aenerf_ns.files.event_hdf5 import TXYP_MATRIX, Hdf5TableFile
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.recording import Recording
from aenerf_ns.recording.views import MAX_VIEWS, image_files_of_poses, views_on_trajectory

_WIDTH, _HEIGHT = 640, 480
# The names that NumPy's arrays and numbers need. All others are refused, because a pickle may run any code.
_HARMLESS = {("_reconstruct", "multiarray"), ("scalar", "multiarray"), ("ndarray", "numpy"), ("dtype", "numpy")}


@dataclass
class PAEv3DDataParserConfig(EvenPosesDataParserConfig):
    """PAEv3D."""

    _target: type = field(default_factory=lambda: PAEv3DDataParser)


class PAEv3DDataParser(EventDataParser):
    """Read a scene, given the folder of its events, or the dataset's folder where that holds one scene only."""

    config: PAEv3DDataParserConfig
    layout = "H5_Files/SCENE/event.h5 with Render_info/SCENE and Intrinsics"

    @classmethod
    def recognises(cls, data: Path) -> bool:
        return bool(_scenes(data))

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
    """Return the folders of events. A trained run is opened without its events, so the file need not exist."""
    if data.parent.name == "H5_Files":
        return [data]
    return sorted(path for path in data.glob("H5_Files/*") if path.is_dir())


class _HarmlessUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (name, module.split(".")[-1]) not in _HARMLESS or module.split(".")[0] != "numpy":
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return super().find_class(module, name)


def _camera_pose(path: Path) -> Tensor:
    """Read the camera's pose in VisionBlender's object_poses: (4, 4) float64, camera-to-world, OpenGL camera axes."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open("object_poses.npy") as member:
            _, _, dtype = read_npy_header(member)
            # An array of dictionaries. NumPy would unpickle it without looking at the names in it.
            objects = _HarmlessUnpickler(member).load() if dtype.hasobject else None
    except (*NPZ_ERRORS, KeyError, pickle.UnpicklingError, AttributeError, ImportError, IndexError, TypeError) as error:
        raise DataError(path, f"its object_poses cannot be read ({error})", "copy it again") from None
    for entry in np.asarray(objects, dtype=object).ravel().tolist():
        if isinstance(entry, dict) and str(entry.get("name")) == "Camera":
            pose = np.asarray(entry.get("pose"))
            if pose.shape != (4, 4) or pose.dtype.kind not in "iuf":
                raise DataError(
                    path, f"its camera's pose has type {pose.dtype} and shape {pose.shape}", "copy it again"
                )
            matrix = torch.from_numpy(pose.astype(np.float64))
            if not matrix.isfinite().all():
                raise DataError(path, "its camera's pose is not finite", "drop it, and its image")
            require_rigid(matrix[None], path)
            return matrix
    raise DataError(path, "its object_poses hold no 'Camera'", "render it with VisionBlender again")


paev3d_dataparser = DataParserSpecification(
    config=PAEv3DDataParserConfig(), description="PAEv3D: H5_Files, Render_info and Intrinsics"
)
