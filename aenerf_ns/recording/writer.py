"""Writing the native dataset format (docs/dataset_format.md), or a recording whose poses are not known."""

from __future__ import annotations

import json
import re
import shutil
from abc import ABC, abstractmethod
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from aenerf_ns.camera.image_encoding import ImageEncoding
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous
from aenerf_ns.errors import DataError, reason
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_hdf5 import Hdf5EventWriter
from aenerf_ns.files.output_paths import output_error
from aenerf_ns.files.text import format_seconds
from aenerf_ns.files.tum_trajectory import write_tum_trajectory
from aenerf_ns.recording.output_lock import OutputLock
from aenerf_ns.recording.poses_report import POSES_REPORT, poses_report_files
from aenerf_ns.recording.recording import SPLITS, Split
from aenerf_ns.recording.views import IMAGE_LIST

_Writer = TypeVar("_Writer", bound="_FolderWriter")


class _FolderWriter(ABC):
    """Write a folder with events, completely or not at all. Use it as a context manager.

    The folder gets its name when the last file is complete. If anything fails, nothing is left behind. An OSError
    within the context, such as on a full disk, becomes a DataError. As long as the writer lives, no other process can
    write the folder.

    Args:
        folder: the folder to create, or the lock on it that the caller holds.
        sensor: see ``sensor`` below.

    Raises:
        DataError: the folder exists, cannot be created, or is being written by another process.

    Attributes:
        events: its method ``append`` takes the events, piece by piece in the order of time.
        sensor: the sensor that took the events, which is written when the block ends.
    """

    def __init__(self, folder: Path | OutputLock, sensor: SensorModel) -> None:
        self.sensor = sensor
        self._cleanup = ExitStack()
        lock = self._cleanup.enter_context(OutputLock(folder)) if isinstance(folder, Path) else folder
        self._folder, self._partial = lock.output, lock.partial
        # A process that was killed may have left it. Nobody else writes it, because the lock is held.
        shutil.rmtree(self._partial, ignore_errors=True)
        self._cleanup.callback(shutil.rmtree, self._partial, ignore_errors=True)
        try:
            self._partial.mkdir()
            self.events = Hdf5EventWriter(self._partial / "events.h5")
        except OSError as error:
            self._cleanup.close()
            raise output_error(self._folder, error) from None

    def __enter__(self: _Writer) -> _Writer:
        return self

    def __exit__(self, error_type: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        try:
            self.events.__exit__(error_type)
            if isinstance(error, OSError):
                raise error
            if error_type is None:
                self._finish()
                self._partial.rename(self._folder)
        except OSError as failure:
            problem = f"it cannot be written ({reason(failure)})"
            raise DataError(self._folder, problem, "check the space and the rights") from None
        finally:
            self._cleanup.close()

    def add_contrast_thresholds(self, positive: NDArray[np.float64], negative: NDArray[np.float64]) -> None:
        """Write the true contrast thresholds of each pixel, (height, width) in log-radiance, for comparisons."""
        np.savez_compressed(self._partial / "thresholds_ground_truth.npz", positive=positive, negative=negative)

    @abstractmethod
    def _finish(self) -> None:
        """Write what is known when all events and images are written."""


class NativeDatasetWriter(_FolderWriter):
    """Write a dataset folder, completely or not at all, as a context manager (see :class:`_FolderWriter`).

    Args:
        folder: the dataset folder to create, or the lock on it that the caller holds.
        event_camera, sensor, image_encoding, max_pose_gap: see :class:`~aenerf_ns.recording.recording.Recording`.
        scene_box: (2, 3) corners of a box that holds the scene, or None for a scene without bounds.
        frame_camera: the lens of the camera that took the images; by default the event camera's.
        frame_from_event: see :class:`~aenerf_ns.recording.recording.Capture`.
        auto_scale_poses: whether training scales the poses by default.
        has_estimated_intrinsics: whether the event camera's lens was estimated together with the poses.
        has_assumed_thresholds: whether nobody states the contrast thresholds.
    """

    def __init__(
        self,
        folder: Path | OutputLock,
        event_camera: CameraIntrinsics,
        sensor: SensorModel,
        image_encoding: ImageEncoding,
        scene_box: NDArray[np.float64] | Tensor | None = None,
        max_pose_gap: int | None = None,
        frame_camera: CameraIntrinsics | None = None,
        auto_scale_poses: bool = True,
        has_estimated_intrinsics: bool = False,
        has_assumed_thresholds: bool = False,
        frame_from_event: Tensor | None = None,
    ) -> None:
        super().__init__(folder, sensor)
        self._camera = event_camera
        frame_camera = event_camera if frame_camera is None else frame_camera
        self._names: dict[tuple[Path, int | None], str] = {}
        self._meta: dict[str, Any] = {
            "w": frame_camera.width,
            "h": frame_camera.height,
            **frame_camera.to_transforms(),
            "image_encoding": image_encoding,
            "event_camera": {"file": "events.h5"},
            "frames": [],
            **{f"{split}_filenames": [] for split in SPLITS},
        }
        if has_estimated_intrinsics:
            self._meta["event_camera"]["intrinsics_origin"] = "estimated"
        if has_assumed_thresholds:
            self._meta["event_camera"]["has_assumed_thresholds"] = True
        if frame_from_event is not None:
            self._meta["event_camera"]["T_frame_event"] = frame_from_event.tolist()
        if not auto_scale_poses:
            self._meta["auto_scale_poses"] = False
        if scene_box is not None:
            self._meta["scene_box"] = scene_box.tolist()
        if max_pose_gap is not None:
            self._meta["max_pose_gap_ns"] = max_pose_gap

    def _finish(self) -> None:
        if not (self._partial / "trajectory_estimated.txt").exists():
            raise ValueError("the dataset has no trajectory: call add_trajectories before leaving the block")
        self._meta["event_camera"] |= _event_camera(self._camera, self.sensor)
        _write_json(self._partial / "transforms.json", self._meta)

    def add_trajectories(self, estimated: Trajectory, ground_truth: Trajectory | None = None) -> None:
        """Write the estimated and, if it is known, the true trajectory (OpenCV camera axes)."""
        write_tum_trajectory(self._partial / "trajectory_estimated.txt", estimated)
        if ground_truth is not None:
            write_tum_trajectory(self._partial / "trajectory_ground_truth.txt", ground_truth)

    def add_poses_report(self, report: dict[str, Any]) -> None:
        """Write how the estimated trajectory was made and what is known of its errors, for people to read."""
        _write_json(self._partial / POSES_REPORT, report)

    def copy_poses_report(self, trajectory: Trajectory) -> None:
        """Copy the report on poses that are written as they were read, and its picture, where there are such files."""
        for file in poses_report_files(trajectory):
            shutil.copyfile(file, self._partial / file.name)

    def other_file(self, name: str) -> Path:
        """Return the path at which another file of the folder can be written until the block ends."""
        return self._partial / name

    def add_image(
        self,
        split: Split,
        image: NDArray[np.uint8],
        camera_to_world: Tensor,
        time: int | None = None,
        *,
        linear: NDArray[np.uint16] | None = None,
        depth: NDArray[np.float32] | None = None,
    ) -> None:
        """Add a reference image.

        Args:
            split: the split that the image belongs to.
            image: (height, width, 3) display values.
            camera_to_world: (3, 4) or (4, 4) pose, OpenCV camera axes.
            time: nanoseconds at which the image was taken on the trajectory, or None.
            linear: (height, width, 3) the same image in linear radiance; 65535 is display white.
            depth: (height, width) along the optical axis, in the unit of the poses' lengths; not finite where it is
                unknown. Depth beyond 65.535 cannot be stored and becomes unknown.
        """
        frame = self._add_frame(split, ".png", camera_to_world, time)
        Image.fromarray(image).save(self._partial / frame["file_path"])
        pictures = {} if linear is None else {"linear": linear[..., ::-1]}
        if depth is not None:
            # Nerfstudio's convention: 16 bits of thousandths, 0 for unknown.
            thousandths = np.rint(np.where(np.isfinite(depth), depth, 0) * 1000.0)
            thousandths[thousandths > np.iinfo(np.uint16).max] = 0
            pictures["depth"] = thousandths.astype(np.uint16)
        for kind, values in pictures.items():
            name = frame[f"{kind}_file_path"] = frame["file_path"].replace("images/", f"{kind}/", 1)
            (self._partial / name).parent.mkdir(parents=True, exist_ok=True)
            # OpenCV's own writing reports no full disk.
            (self._partial / name).write_bytes(cv2.imencode(".png", values)[1].tobytes())

    def add_image_file(
        self,
        split: Split,
        file: Path,
        camera_to_world: Tensor,
        time: int | None = None,
        background: tuple[float, float, float] | None = None,
    ) -> None:
        """Add a reference image by copying its file, once for several splits and anew for another time.

        ``background``, RGB in [0, 1] in the image's encoding, is composed with an image that has an alpha channel,
        because the dataset format has none. The other arguments are those of :meth:`add_image`.
        """
        if (file, time) in self._names:
            self._meta[f"{split}_filenames"].append(self._names[file, time])
            return
        with Image.open(file) as image:
            values = None if background is None or image.mode != "RGBA" else np.asarray(image, np.float64) / 255
        name = self._add_frame(split, file.suffix if values is None else ".png", camera_to_world, time)["file_path"]
        self._names[file, time] = name
        if values is None:
            shutil.copyfile(file, self._partial / name)
            return
        alpha = values[..., 3:]
        composed = values[..., :3] * alpha + np.array(background) * (1 - alpha)
        Image.fromarray(np.rint(composed * 255).astype(np.uint8)).save(self._partial / name)

    def _add_frame(self, split: Split, suffix: str, camera_to_world: Tensor, time: int | None) -> dict[str, Any]:
        names = self._meta[f"{split}_filenames"]
        name = f"images/{split}/{len(names):05d}{suffix}"
        (self._partial / name).parent.mkdir(parents=True, exist_ok=True)
        frame: dict[str, Any] = {
            "file_path": name,
            "transform_matrix": (homogeneous(camera_to_world[:3].double()) @ OPENCV_TO_OPENGL).tolist(),
        }
        if time is not None:
            frame["timestamp"] = format_seconds(time)
        self._meta["frames"].append(frame)
        names.append(name)
        return frame


class PoselessRecordingWriter(_FolderWriter):
    """Write a folder of events and images without poses, completely or not at all, as a context manager.

    With a trajectory.txt beside them, the files are a recording of the format ``event-recording-data``. Where the lens
    of the sensor that took events and images is not known, there is no calibration.json.
    """

    def __init__(self, folder: Path | OutputLock, camera: CameraIntrinsics | None, sensor: SensorModel) -> None:
        super().__init__(folder, sensor)
        self._camera = camera
        self._images: list[str] = []

    def _finish(self) -> None:
        lines = ["# t[s] file", *self._images]
        (self._partial / IMAGE_LIST).write_text("\n".join(lines) + "\n", encoding="utf-8")
        if self._camera is not None:
            calibration = {"image_encoding": "srgb", "event_camera": _event_camera(self._camera, self.sensor)}
            _write_json(self._partial / "calibration.json", calibration)

    def add_image(self, image: NDArray[np.uint8], time: int) -> None:
        """Add an sRGB image (height, width, 3) that was taken at a time in nanoseconds, later than the one before."""
        name = f"images/{len(self._images):05d}.png"
        (self._partial / "images").mkdir(exist_ok=True)
        Image.fromarray(image).save(self._partial / name)
        self._images.append(f"{format_seconds(time)} {name}")


def _write_json(path: Path, values: dict[str, Any]) -> None:
    # A JSON number may have any number of digits, but Python's json cannot write an exact decimal: times are stored as
    # strings, and their quotes are removed here.
    text = re.sub(r'"timestamp": "([-0-9.]+)"', r'"timestamp": \1', json.dumps(values, indent=2))
    path.write_text(text + "\n", encoding="utf-8")


def _event_camera(camera: CameraIntrinsics, sensor: SensorModel) -> dict[str, Any]:
    return {
        "width": camera.width,
        "height": camera.height,
        **camera.to_transforms(),
        "positive_contrast_threshold": sensor.positive_contrast_threshold,
        "negative_contrast_threshold": sensor.negative_contrast_threshold,
        "refractory_period_ns": sensor.refractory_period,
        "bandwidth_hz": sensor.bandwidth,
        "bayer_pattern": sensor.bayer_pattern,
    }
