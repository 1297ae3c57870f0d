"""Cubic splines through timed poses."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.ndimage import binary_opening
from torch import Tensor

from aenerf_ns.camera.rotation import quaternion_from_rotation, rotation_from_quaternion
from aenerf_ns.camera.time_window import runs_of

# Four lost frames in a row make a segment five times as long as its neighbors. The errors of the poses at its ends
# grow with its length, but the spline is still closer to the path than a straight line (benchmarks/LOG.md).
_MAX_SEGMENT_RATIO = 5.5
# Closer to half a turn, the shorter way round is hardly known.
_MAX_TURN = math.radians(150)


def pose_polynomials(seconds: Tensor, poses: Tensor) -> Tensor:
    """Return cubic polynomials of time that pass through poses.

    Positions and quaternions follow a cubic spline with continuous first and second derivatives. The first two segments
    of a spline are one polynomial, and so are the last two ("not-a-knot"). The quaternion has unit length at the poses
    only; the rotation is that of its direction.

    A spline would swing in a gap. So the spline ends where a gap begins, and another spline begins where the gap ends.
    In the gap the position moves straight at a constant speed, and the rotation turns about one axis at an almost
    constant rate. A gap is a segment more than 5.5 times as long as one of its neighbors, or one that turns by more
    than 150 degrees. Two poses alone are joined like the ends of a gap, and three by a parabola.

    Args:
        seconds: (N,) float64 times, strictly increasing, N >= 2.
        poses: (N, 3, 4) float64 rigid motions.

    Returns:
        (N - 1, 4, 7) float64 coefficients of 1, t, t² and t³ on each segment, where t are the seconds since its start.
        The columns are x, y, z of the position, and x, y, z, w of the quaternion.
    """
    quaternions = quaternion_from_rotation(poses[:, :, :3])
    # A quaternion and its negative are one rotation. The spline takes the one closer to the quaternion before it.
    flips = torch.where((quaternions[1:] * quaternions[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(poses.dtype)
    quaternions = torch.cat([quaternions[:1], quaternions[1:] * flips.cumprod(0)])
    # A rotation turns by twice the angle between its quaternions.
    start, end = quaternions[:-1], quaternions[1:]
    angles = 2 * torch.atan2((end - start).norm(dim=-1, keepdim=True), (end + start).norm(dim=-1, keepdim=True))
    values = torch.cat([poses[:, :, 3], quaternions], -1)
    steps = seconds.diff()[:, None]
    chords = values.diff(dim=0) / steps
    known = ~is_gap(steps[:, 0]) & (2 * angles[:, 0] <= _MAX_TURN)
    # The slopes of steady motions, in which quaternions move along great circles.
    scale = 1 / (torch.sinc(angles / math.pi) * steps)
    leaving = torch.cat([chords[:, :3], scale * (end - torch.cos(angles) * start)], -1)
    arriving = torch.cat([chords[:, :3], scale * (torch.cos(angles) * end - start)], -1)
    # A spline begins and ends where a segment that belongs to one meets a segment, or an end, that does not. Opening
    # drops runs of one segment: a spline needs two.
    for first, last in runs_of(binary_opening(known.cpu().numpy(), np.ones(2))):
        x, y = (column[first : last + 1].cpu().numpy() for column in (seconds, values))
        slopes = torch.from_numpy(CubicSpline(x, y, bc_type="not-a-knot")(x, 1)).to(values)
        leaving[first:last], arriving[first:last] = slopes[:-1], slopes[1:]
    second, third = 3 * chords - 2 * leaving - arriving, leaving + arriving - 2 * chords
    return torch.stack([values[:-1], leaving, second / steps, third / steps**2], 1)


def rotation_from_products() -> Tensor:
    """Return the (16, 9) float64 matrix that makes a rotation of the products of a quaternion's components.

    It maps the (4, 4) products q qᵀ of a unit quaternion x, y, z, w, flattened, to the flattened rotation matrix. It
    maps the products of q and its rate to half of the rotation's rate.
    """
    identity = torch.eye(4, dtype=torch.float64)
    sums = (identity[:, None] + identity).flatten(0, 1)
    one, two = (rotation_from_quaternion(q).flatten(1) * q.square().sum(-1, keepdim=True) for q in (identity, sums))
    # The matrix of a quadratic form f is (f(a + b) − f(a) − f(b)) / 2. Here it holds whole numbers.
    return ((two.unflatten(0, (4, 4)) - one[:, None] - one) / 2).round().flatten(0, 1)


def is_gap(steps: Tensor) -> Tensor:
    """Return which of segments of (N,) lengths are more than 5.5 times as long as one of their neighbors."""
    longest = torch.full_like(steps, math.inf)
    longest[1:] = _MAX_SEGMENT_RATIO * steps[:-1]
    longest[:-1] = torch.minimum(longest[:-1], _MAX_SEGMENT_RATIO * steps[1:])
    return steps > longest
