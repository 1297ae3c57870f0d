"""Trajectories in the text format of the TUM RGB-D benchmark: t tx ty tz qx qy qz qw, in seconds, camera-to-world."""

from __future__ import annotations

import re
from itertools import takewhile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.rotation import quaternion_from_rotation, rotation_from_quaternion
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.errors import DataError, require_file
from aenerf_ns.files.limits import MAX_LINE
from aenerf_ns.files.text import POSE_COLUMNS, TimeUnit, format_seconds, parse_numbers, parse_times, read_rows

# Trajectories are commonly printed with six or more digits, so quaternions have rounding errors.
_MAX_NORM_ERROR = 1e-3
# A line of names, which begins with that of the times.
_NAMES = re.compile(r"\W*(t|ts|time\w*|stamp)\b")
# The beginning of a line that holds a pose.
_POSE = re.compile(r"\s*[-+.\d]")


def read_tum_trajectory(path: Path, unit: TimeUnit = "s") -> Trajectory:
    """Read camera-to-world poses, with the axes of the file, from lines of t tx ty tz qx qy qz qw.

    Some datasets have the same rows with other units of the times. # starts a comment. A line ahead of the poses may
    name the columns, and then counts: EuRoC's has nanoseconds and qw first.

    Raises:
        DataError: the file is missing, a value is not finite, a quaternion is not of unit length, or the times do
            not increase.
    """
    require_file(path)
    rows = read_rows(path, POSE_COLUMNS)
    if not rows:
        raise DataError(path, "the file holds no poses", "write one pose a line: t tx ty tz qx qy qz qw")
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = takewhile(lambda line: not _POSE.match(line), iter(lambda: file.readline(MAX_LINE), ""))
        header = [line.lower() for line in lines if _NAMES.match(line.lower())]
    stated = next(filter(None, (re.match(r"\W*\w+ *\[(ns|us|ms|s)\]", line) for line in header)), None)
    times = parse_times(path, [row[0] for row in rows], stated[1] if stated else unit)  # type: ignore[arg-type]
    values = parse_numbers(path, [row[1:] for row in rows])
    orders = [re.findall(r"\bq\w*?([wxyz])\b", line)[:4] for line in header]
    if "".join(next((order for order in reversed(orders) if len(order) == 4), [])) == "wxyz":
        values = values[:, [0, 1, 2, 4, 5, 6, 3]]
    return Trajectory(times, poses_from_quaternions(path, values[:, :3], values[:, 3:]), path)


def poses_from_quaternions(source: Path, positions: NDArray[np.float64], quaternions: NDArray[np.float64]) -> Tensor:
    """Return the (N, 4, 4) float64 poses of (N, 3) positions and (N, 4) quaternions with w last.

    Raises:
        DataError: a value is not finite, or a quaternion is not of unit length.
    """
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quaternions, axis=1)
    # NaN compares as false.
    good = np.isfinite(positions).all(1) & (np.abs(norms - 1) <= _MAX_NORM_ERROR)
    if not good.all():
        index = int(np.argmin(good))
        values = " ".join(f"{value:g}" for value in (*positions[index], *quaternions[index]))
        remedy = "write finite positions and unit quaternions, in the order qx qy qz qw"
        raise DataError(source, f"pose {index} holds {values}", remedy)
    rotations = rotation_from_quaternion(torch.from_numpy(quaternions / norms[:, None]))
    return homogeneous(torch.cat([rotations, torch.from_numpy(positions[:, :, None])], -1))


def write_tum_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory with poses to 12 digits and times to the nanosecond."""
    quaternions = quaternion_from_rotation(trajectory.camera_to_worlds[:, :, :3])
    values = torch.cat([trajectory.camera_to_worlds[:, :, 3], quaternions], -1)
    with path.open("w", encoding="utf-8") as file:
        file.write("# t[s] tx ty tz qx qy qz qw, camera-to-world, OpenCV camera axes\n")
        for time, row in zip(trajectory.times.tolist(), values.tolist(), strict=True):
            file.write(f"{format_seconds(time)} {' '.join(f'{value:.12g}' for value in row)}\n")
