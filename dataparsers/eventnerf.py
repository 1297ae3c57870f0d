"""The format of EventNeRF (Rudnev et al. 2023), which follows NeRF++'s: text files of matrices, and events without a
stated unit of time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from torch import Tensor

from aenerf_ns.camera.lens import EventCamera
from aenerf_ns.camera.trajectory import Trajectory, require_rigid
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventFile
from aenerf_ns.files.event_arrays import XYTP_MEMBERS, NpzEventFile
from aenerf_ns.files.text import TimeUnit
from aenerf_ns.recording.dataparser import EventDataParser, ObjectDataParserConfig
from aenerf_ns.recording.recording import Recording, ReferenceView, Split
from aenerf_ns.recording.views import MAX_VIEWS, image_files, views_on_trajectory

# A DAVIS 346C.
_WIDTH, _HEIGHT = 346, 260
# NeRF++ scales the cameras of a scene into the unit sphere.
UNIT_SPHERE = 1.0


@dataclass
class EvenPosesDataParserConfig(ObjectDataParserConfig):
    """Poses without times, which are evenly spread over the events."""

    time_unit: TimeUnit | None = None
    """Unit of the times of the events. By default whole numbers are microseconds and decimals seconds."""
    first_pose_time_ns: int | None = None
    """Time of the first pose on the clock of the events, in nanoseconds, in place of the format's rule. A run's saved
    configuration holds the value that was used."""
    last_pose_time_ns: int | None = None
    """Time of the last pose, likewise; by default that of the last event."""

    def spread(self, poses: Tensor, event_file: EventFile, source: Path, first: int | None = None) -> Trajectory:
        """The trajectory of (N, 4, 4) poses at even times, of which the first is by default that of the first event.
        Stores them in the configuration, so that opening a trained run needs no events."""
        if self.last_pose_time_ns is None or (self.first_pose_time_ns is None and first is None):
            start, end = event_file.time_span()
            first = start if first is None else first
            self.last_pose_time_ns = end if self.last_pose_time_ns is None else self.last_pose_time_ns
        if self.first_pose_time_ns is None:
            self.first_pose_time_ns = first
        assert self.first_pose_time_ns is not None
        duration, steps = self.last_pose_time_ns - self.first_pose_time_ns, max(len(poses) - 1, 1)
        times = [self.first_pose_time_ns + duration * index // steps for index in range(len(poses))]
        return Trajectory(times, poses, source)


@dataclass
class EventNeRFDataParserConfig(EvenPosesDataParserConfig):
    """EventNeRF."""

    _target: type = field(default_factory=lambda: EventNeRFDataParser)
    color: bool = True
    """Whether the sensor has the colour filter RGGB."""


class EventNeRFDataParser(EventDataParser):
    """Reads the training split of a scene, with the views of its splits "validation" and "test" where there are any.
    The folder given may be that of a split, for scenes with several to train on."""

    config: EventNeRFDataParserConfig
    layout = "train/events/*.npz with train/pose and train/intrinsics"

    @classmethod
    def recognises(cls, data: Path) -> bool:
        return any((split / "pose").is_dir() and (split / "intrinsics").is_dir() for split in _training_splits(data))

    def read_recording(self) -> Recording:
        data = Path(self.config.data)
        splits = [split for split in _training_splits(data) if (split / "pose").is_dir()]
        if not splits:
            raise DataError(data, "there is no train/pose", "give the folder of a scene or of one of its splits")
        if len(splits) > 1:
            raise DataError(data, f"it holds {len(splits)} training splits", f"give one as --data, such as {splits[0]}")
        split = splits[0]
        camera = read_intrinsics(split / "intrinsics", _WIDTH, _HEIGHT)
        events = sorted((split / "events").glob("*.npz"))
        if len(events) > 1:
            raise DataError(split / "events", f"it holds {len(events)} .npz files", "there must be one")
        event_file = NpzEventFile(
            events[0] if events else split / "events" / "events.npz",
            _WIDTH,
            _HEIGHT,
            XYTP_MEMBERS,
            self.config.time_unit,
        )
        poses = _read_poses(split)
        # Pose i of N is at i / (N - 1) of the last event's time.
        reference = self.config.spread(poses, event_file, split / "pose", first=0)
        trajectory, ground_truth = self.config.estimated(reference)
        images = image_files(split / "rgb")
        if images and len(images) != len(poses):
            raise DataError(split / "rgb", f"it holds {len(images)} images for {len(poses)} poses", "copy all of them")
        timed = list(zip(reference.times.tolist(), images, strict=True)) if images else []
        views = views_on_trajectory(timed, reference)
        views.update(_held_out_views(split.parent))
        return Recording(
            event_file=event_file,
            event_camera=camera,
            sensor=self.config.sensor(SensorModel(bayer_pattern="RGGB" if self.config.color else "")),
            trajectory=trajectory,
            ground_truth=ground_truth,
            max_views=MAX_VIEWS,
            frame_camera=camera,
            reference_views=views,
            image_encoding="srgb",
            scene_box=self.config.scene_box(UNIT_SPHERE),
        )


def _training_splits(data: Path) -> list[Path]:
    return [data] if (data / "pose").is_dir() else sorted(path for path in data.glob("train*") if path.is_dir())


def _held_out_views(scene: Path) -> dict[Split, list[ReferenceView]]:
    """The views of the splits that have any. Where one is missing, the other stands in for it."""
    found: list[list[ReferenceView]] = []
    for name in ("validation", "test"):
        images = image_files(scene / name / "rgb")
        if images:
            poses = _read_poses(scene / name)
            if len(images) != len(poses):
                raise DataError(
                    scene / name / "rgb", f"it holds {len(images)} images for {len(poses)} poses", "copy all of them"
                )
            found.append([ReferenceView(file, pose, None) for file, pose in zip(images, poses, strict=True)])
    if not found:
        return {}
    if len(found) == 1:
        return {"val": found[0][::2], "test": found[0][1::2]}
    return {"val": found[0], "test": found[1]}


def _read_poses(split: Path) -> Tensor:
    """(N, 4, 4) camera-to-world poses, OpenCV camera axes."""
    files = sorted((split / "pose").glob("*.txt"))
    if not files:
        raise DataError(split / "pose", "it holds no .txt file", "copy the poses of the dataset to it")
    poses = torch.stack([torch.from_numpy(read_matrix(file, 4)) for file in files])
    require_rigid(poses, split / "pose")
    return poses


def read_matrix(path: Path, *num_rows: int) -> np.ndarray:
    """The float64 matrix of four columns in a text file, of one of the numbers of rows given.

    Raises:
        DataError: the file is missing or malformed, or a number is not finite.
    """
    if not path.is_file():
        raise DataError(path, "there is no such file", "copy the whole dataset")
    fields = path.read_text(encoding="utf-8", errors="replace").split()
    if len(fields) not in [4 * rows for rows in num_rows]:
        raise DataError(
            path, f"it holds {len(fields)} numbers", f"it must hold {' or '.join(f'{rows} x 4' for rows in num_rows)}"
        )
    try:
        matrix = np.array(fields, dtype=np.float64).reshape(-1, 4)
    except ValueError as error:
        raise DataError(path, f"not a number ({error})", "write plain decimal numbers") from None
    if not np.isfinite(matrix).all():
        raise DataError(path, "a number is not finite", "drop it, and its image")
    return matrix


def read_intrinsics(folder: Path, width: int, height: int) -> EventCamera:
    """The lens in the first of a folder's files, which holds a 4 x 4 matrix and perhaps a line with k1 and k2.

    Raises:
        DataError: there is none, or it is malformed.
    """
    files = sorted(folder.glob("*.txt"))
    if not files:
        raise DataError(folder, "it holds no .txt file", "copy the intrinsics of the dataset to it")
    matrix = read_matrix(files[0], 4, 5).tolist()
    k1, k2 = matrix[4][:2] if len(matrix) == 5 else (0.0, 0.0)
    try:
        # NeRF++ counts from the edge of the image, as here.
        return EventCamera(
            width,
            height,
            fx=matrix[0][0],
            fy=matrix[1][1],
            cx=matrix[0][2],
            cy=matrix[1][2],
            distortion=(k1, k2, 0.0, 0.0, 0.0),
        )
    except ValueError as error:
        raise DataError(files[0], str(error), "it must hold the matrix of the intrinsics") from None


eventnerf_dataparser = DataParserSpecification(
    config=EventNeRFDataParserConfig(), description="EventNeRF: train/events/*.npz, pose and intrinsics"
)
