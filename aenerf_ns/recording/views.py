"""Reference views: reading lists of images, placing images on a trajectory, and choosing the views that are used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.limits import file_inside, visible_files
from aenerf_ns.files.text import UNIT_NAMES, TimeUnit, parse_times, read_rows
from aenerf_ns.recording.recording import ReferenceView, Split
from aenerf_ns.recording.time_units import unit_steps

IMAGE_LIST = "images.txt"
"""The file in a folder that holds, on each line, a time in seconds and an image."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

MAX_VIEWS = 30
"""Images of a split that a published format uses at most: as many as the paper evaluates TUM-VIE on. Each is rendered
to fit the color correction or to evaluate, and cameras take thousands."""

# Training cameras only serve the viewer. The viewer and Nerfstudio's start slow down with their number.
_MAX_SHOWN = 24

Item = TypeVar("Item")


def image_files(folder: Path) -> list[Path]:
    """Return the PNG and JPEG images of a folder in the order of their names; none if the folder does not exist."""
    return [file for file in visible_files(folder, "*") if file.suffix.lower() in IMAGE_SUFFIXES]


def image_files_of_poses(folder: Path, num_poses: int) -> list[Path]:
    """Return the images of a folder in the order of their names: none, or one for each pose.

    Raises:
        DataError: the folder holds images, but not as many as there are poses.
    """
    files = image_files(folder)
    if files and len(files) != num_poses:
        raise DataError(folder, f"it holds {len(files)} images for {num_poses} poses", "copy all of them")
    return files


def read_image_list(path: Path) -> list[tuple[int, Path]]:
    """Read times in nanoseconds and files from a list: on each line seconds, and the file relative to its folder.

    A line ahead of them may state another unit: timestamp [us],filename.

    Raises:
        DataError: the list or an image is missing, or a line does not hold the two.
    """
    rows, _, stated = read_rows(path, "t file")
    # Ahead of the files: the columns may be swapped.
    times = parse_times(path, [row[0] for row in rows], stated or "s").tolist()
    files = [file_inside(path.parent, name, path) for _, name in rows]
    for file, (_, name) in zip(files, rows, strict=True):
        with reading(file):
            if not file.is_file():
                raise DataError(path, f"it names {name}, which does not exist", "copy the images too")
    return list(zip(times, files, strict=True))


def read_image_times(folder: Path, path: Path, unit: TimeUnit) -> list[tuple[int, Path]]:
    """Read times in nanoseconds and files of a folder's images; none if it holds none.

    Args:
        folder: the images.
        path: the list of the times, one on each line, in the order of the images' names.
        unit: of the times in the list.

    Raises:
        DataError: the list is missing, or there are not as many times as images.
    """
    files = image_files(folder)
    if not files:
        return []
    times = parse_times(path, [row[0] for row in read_rows(path, "t")[0]], unit).tolist()
    if len(files) != len(times):
        problem = f"it has {len(times)} times for {len(files)} images"
        raise DataError(path, problem, "copy all images and the list of their times")
    return list(zip(times, files, strict=True))


def views_on_trajectory(
    images: Sequence[tuple[int, Path]],
    trajectory: Trajectory,
    event_from_frame: Tensor | None = None,
    max_pose_gap: int | None = None,
) -> dict[Split, list[ReferenceView]]:
    """Place images at the interpolated poses of their times. Images taken outside the poses or in a gap are left out.

    Args:
        images: times in nanoseconds, and files.
        trajectory: of the event camera, camera-to-world, OpenCV camera axes.
        event_from_frame: (4, 4) float64, takes points from the frame camera's to the event camera's coordinates. None:
            one sensor takes both.
        max_pose_gap: nanoseconds; an image between poses that are further apart is left out. None: those in the gaps of
            :meth:`~aenerf_ns.camera.trajectory.Trajectory.time_without_gaps` are.

    Returns:
        All views as train views, and the same alternating between the validation and the test split.
    """
    times = [time for time, _ in images]
    if images:
        require_distinct_times(times, images[0][1].parent)
    known = trajectory.time_without_gaps() if max_pose_gap is None else trajectory.known_time(max_pose_gap)
    kept = [(time, file) for time, file in images if known.contains(time)]
    if len(kept) <= max(1, len(images) // 10):
        require_seconds(times, images[0][1].parent if images else Path(), "poses", (trajectory.start, trajectory.end))
    if len(kept) < len(images):
        CONSOLE.print(
            f"{len(images) - len(kept)} of {len(images)} images are left out: they were taken outside the poses, or in "
            "a gap of them."
        )
    mount = torch.eye(4, dtype=torch.float64) if event_from_frame is None else event_from_frame
    views = [ReferenceView(file, homogeneous(trajectory.interpolate(time)) @ mount, time) for time, file in kept]
    return {"train": views, "val": views[::2], "test": views[1::2]}


def require_distinct_times(times: Sequence[int], source: Path) -> None:
    """Raise a DataError if two of the images that a file or folder lists were taken at one time, in nanoseconds."""
    if len(set(times)) < len(times):
        seconds = Counter(times).most_common(1)[0][0] * 1e-9
        problem = f"several images are at {seconds:.9f} s"
        raise DataError(source, problem, "give each image its own time, with all digits")


def require_seconds(times: list[int], source: Path, name: str, span: tuple[int, int]) -> None:
    """Raise a DataError if images fit a span of time, of the poses or events, only if their times are not seconds."""
    power = unit_steps((min(times), max(times)), span) if len(times) > 1 else None
    if power is not None:
        seconds = (max(times) - min(times)) * 1e-9
        unit, remedy = f"{1000 ** max(power, 0):,} times too small", "correct their unit"
        if power < 0:
            unit, remedy = f"in {list(UNIT_NAMES.values())[power - 1]}", "write the times of the images in seconds"
        raise DataError(
            source,
            f"the {name} last {(span[1] - span[0]) * 1e-9:g} s and the images {seconds:g} s, as if the times of the "
            f"images were {unit}",
            remedy,
        )


def views_within(views: list[ReferenceView], window: TimeWindow) -> list[ReferenceView]:
    """Return the views that were taken in a time window or at no known time; print how many others there are."""
    kept = [view for view in views if view.time is None or window.contains(view.time)]
    if len(kept) < len(views):
        CONSOLE.print(
            f"{len(views) - len(kept)} of {len(views)} reference images are left out: they were taken outside the "
            f"events' {window.start} to {window.end} ns or in a gap of the poses."
        )
    return kept


def thin_views(views: list[ReferenceView], max_views: int | None) -> list[ReferenceView]:
    """Return at most ``max_views`` of the timed views, evenly spread in their order, and all views without a time."""
    timed = [view for view in views if view.time is not None]
    if max_views is None or len(timed) <= max_views:
        return views
    return [*spread_evenly(timed, max_views), *(view for view in views if view.time is None)]


def viewer_cameras(trajectory: Trajectory, views: list[ReferenceView]) -> tuple[Tensor, dict[int, Path]]:
    """Choose knots and times of images at which the viewer shows the camera: (N,) int64 nanoseconds, and the images
    among them by index."""
    taken = {v.time: v.file for v in views if v.time is not None and trajectory.start <= v.time <= trajectory.end}
    shown = spread_evenly(sorted(taken), _MAX_SHOWN)
    times = sorted({*spread_evenly(trajectory.times.tolist(), _MAX_SHOWN), *shown})
    return torch.tensor(times), {times.index(time): taken[time] for time in shown}


def seconds_on_trajectory(views: list[ReferenceView], trajectory: Trajectory) -> Tensor:
    """Return when views were taken: (N, 1) float64 seconds since the trajectory's start, NaN for untimed views."""
    times = [torch.nan if view.time is None else (view.time - trajectory.start) * 1e-9 for view in views]
    return torch.tensor(times, dtype=torch.float64)[:, None]


def spread_evenly(items: Sequence[Item], max_items: int) -> list[Item]:
    """Return at most ``max_items`` of the items, evenly spread from the first to the last."""
    count = min(len(items), max_items)
    return [items[round(i * (len(items) - 1) / max(count - 1, 1))] for i in range(count)]


def move_views(views: Sequence[ReferenceView], given: Trajectory, refined: Trajectory) -> list[ReferenceView]:
    """Move views of known times as the poses at these times move from one trajectory to another, in one world."""
    known = given.known_time()
    moved = []
    for view in views:
        if view.time is not None and known.contains(view.time):
            before, after = (homogeneous(path.interpolate([view.time])[0]) for path in (given, refined))
            view = replace(view, camera_to_world=after @ torch.linalg.inv(before) @ view.camera_to_world)
        moved.append(view)
    return moved
