"""Trajectories in the text format of the TUM RGB-D benchmark: t tx ty tz qx qy qz qw, in seconds, camera-to-world."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.rotation import quaternion_from_rotation, rotation_from_quaternion
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.files.text import (
    POSE_COLUMNS,
    TIME_NAME,
    TimeUnit,
    format_seconds,
    parse_numbers,
    parse_times,
    read_rows,
)

# Trajectories are commonly printed with six or more digits, so quaternions have rounding errors.
_MAX_NORM_ERROR = 1e-3


def read_tum_trajectory(path: Path, unit: TimeUnit = "s") -> Trajectory:
    """Read camera-to-world poses, with the axes of the file, from lines of t tx ty tz qx qy qz qw.

    Some datasets have the same rows with other units of the times. # starts a comment. A line ahead of the poses may
    name the columns, and then counts: EuRoC's has nanoseconds and qw first. q0 is w.

    Raises:
        DataError: the file is missing, a value is not finite, a quaternion is not of unit length, or the times do
            not increase.
    """
    rows, header, stated = read_rows(path, POSE_COLUMNS)
    if not rows:
        raise DataError(path, "the file holds no poses", "write one pose a line: t tx ty tz qx qy qz qw")
    times = parse_times(path, [row[0] for row in rows], stated or unit)
    values = parse_numbers(path, [row[1:] for row in rows])
    orders = [order for order in map(_quaternion_order, header) if sorted(order) in (sorted("wxyz"), sorted("0123"))]
    order = orders[-1] if orders else "xyzw"
    if order in ("wxyz", "0123"):
        values = values[:, [0, 1, 2, 4, 5, 6, 3]]
    elif order != "xyzw":
        problem = f"its names put the quaternion's columns in the order {' '.join(order)}"
        raise DataError(path, problem, "write them in the order qx qy qz qw, or w first")
    return Trajectory(times, poses_from_quaternions(path, values[:, :3], values[:, 3:]), path)


def _quaternion_order(line: str) -> str:
    """Return how the names of a quaternion's four columns end in a line that names all columns, such as wxyz."""
    names = re.sub(r"\[[^][]*\]|[#\"',]", " ", line).split()
    if len(names) == len(POSE_COLUMNS.split()):
        names = names[4:]
    else:
        names = re.findall(r"\bq\w*?[wxyzrijk]\b", line)[:4] if TIME_NAME.match(line) else []
    order = "".join(name[-1] for name in names)
    # By the real part and the three imaginary units.
    return order.translate(str.maketrans("rijk", "wxyz")) if sorted(order) == sorted("rijk") else order


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
