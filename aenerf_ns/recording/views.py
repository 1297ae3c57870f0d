"""Reference views of a camera that moves with the event camera, taken at known times."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.files.text import TimeUnit, parse_times, read_rows
from aenerf_ns.recording.recording import ReferenceView, Split

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

MAX_VIEWS = 20
"""Images of a split that are used at most: each is rendered to fit the colour correction or to evaluate, and cameras
take thousands."""


def image_files(folder: Path) -> list[Path]:
    """The PNG and JPEG images of a folder in the order of their names; none where there is no such folder."""
    return sorted(file for file in folder.glob("*") if file.suffix.lower() in IMAGE_SUFFIXES)


def read_image_list(path: Path) -> list[tuple[int, Path]]:
    """Times in nanoseconds and files of a list of images: a line for each, with its time in seconds and its file,
    relative to the list's folder.

    Raises:
        DataError: the list or an image is missing, or a line does not hold the two.
    """
    rows = read_rows(path, "t file")
    for _, name in rows:
        if not (path.parent / name).is_file():
            raise DataError(path, f"it names {name}, which does not exist", "copy the images too")
    times = parse_times(path, [row[0] for row in rows])
    return [(int(time), path.parent / name) for time, (_, name) in zip(times, rows, strict=True)]


def read_image_times(folder: Path, path: Path, unit: TimeUnit) -> list[tuple[int, Path]]:
    """Times in nanoseconds and files of a folder's images in the order of their names, of which another file lists the
    times. None where the folder holds no images.

    Raises:
        DataError: the list is missing, or not as long.
    """
    files = image_files(folder)
    if not files:
        return []
    times = parse_times(path, [row[0] for row in read_rows(path, "t")], unit).tolist()
    if len(files) != len(times):
        raise DataError(
            path, f"it has {len(times)} times for {len(files)} images", "copy all images and the list of their times"
        )
    return list(zip(times, files, strict=True))


def views_on_trajectory(
    images: Sequence[tuple[int, Path]],
    trajectory: Trajectory,
    event_from_frame: Tensor | None = None,
    max_pose_gap: int | None = None,
) -> dict[Split, list[ReferenceView]]:
    """The images that were taken within the span of the poses, each at the interpolated pose of its time. They
    alternate between the validation and the test split.

    Args:
        images: times in nanoseconds, and files.
        trajectory: of the event camera, camera-to-world, OpenCV camera axes.
        event_from_frame: (4, 4) float64, takes points from the frame camera's to the event camera's coordinates, or
            None where one sensor takes both.
        max_pose_gap: nanoseconds between poses beyond which no image there is kept, or None.
    """
    known = trajectory.window(max_pose_gap)
    kept = [(time, file) for time, file in images if known.contains(time)]
    if len(kept) < len(images):
        CONSOLE.print(
            f"{len(images) - len(kept)} of {len(images)} images are left out: they were taken outside the poses."
        )
    if event_from_frame is None:
        event_from_frame = torch.eye(4, dtype=torch.float64)
    views = [
        ReferenceView(file, homogeneous(trajectory.interpolate(time)) @ event_from_frame, time) for time, file in kept
    ]
    return {"train": views, "val": views[::2], "test": views[1::2]}
