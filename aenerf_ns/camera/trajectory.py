"""A camera trajectory: timed poses, and the pose at any time between them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from aenerf_ns.camera.pose_spline import is_gap, pose_polynomials, rotation_from_products
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.errors import DataError

# Multiplying camera-to-world poses by it from the right turns OpenCV camera axes (x right, y down, z forward) into
# Nerfstudio's OpenGL camera axes (x right, y up, z backward), and back.
OPENCV_TO_OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))

# Matrices printed with five digits pass.
_MAX_RIGIDITY_ERROR = 1e-4
# Positions beyond it, in any unit, have no digits left for the motion.
_MAX_POSITION = 1e12


class Trajectory(nn.Module):
    """Camera-to-world poses in continuous time (paper, appendix "Training").

    The poses pass through the knots. Between knots, positions and rotations follow cubic splines with continuous
    velocities and accelerations (:func:`~aenerf_ns.camera.pose_spline.pose_polynomials`). No spline crosses a gap,
    which is a segment much longer than its neighbors. There the camera moves straight and turns about one axis.

    It is a module so that the knots move with a model to its device. It has no parameters and adds nothing to
    checkpoints. Everything is float64, and times are integer nanoseconds or float64 seconds since ``start``: in float32
    two events of one pixel would get the same time.

    Args:
        times: (N,) times of the knots in nanoseconds, strictly increasing, N >= 2.
        camera_to_worlds: (N, 3, 4) or (N, 4, 4) poses, of any convention for the camera's axes.
        source: the file or folder of the poses, for messages.

    Raises:
        DataError: fewer than two poses, times that do not increase, a value that is not finite or a position beyond
            1e12, or a matrix that is not a rotation.

    Example:
        A camera that moves one unit along x within a second, seen after half of it:

        >>> poses = torch.eye(4).repeat(2, 1, 1)
        >>> poses[1, 0, 3] = 1.0
        >>> trajectory = Trajectory([0, 1_000_000_000], poses)
        >>> trajectory.interpolate(500_000_000)[:, 3]
        tensor([0.5000, 0.0000, 0.0000], dtype=torch.float64)
    """

    def __init__(self, times: ArrayLike | Tensor, camera_to_worlds: Tensor, source: str | Path = "trajectory") -> None:
        super().__init__()
        self.source = source
        times = _as_times(times)
        poses = camera_to_worlds.detach().to(torch.float64)[:, :3, :4]
        if len(times) != len(poses) or len(times) < 2:
            raise DataError(source, f"{len(times)} times and {len(poses)} poses", "give at least two timed poses")
        seconds = _to_seconds(times - times[0])
        # Nanoseconds apart a century from the start, times are equal in seconds, too.
        backward = seconds.diff() <= 0
        if backward.any():
            index = int(backward.nonzero()[0]) + 1
            ahead, time = times[index - 1 : index + 1].tolist()
            problem = f"pose {index} is at {time} ns, not after the pose ahead of it at {ahead} ns"
            remedy = "drop repeated poses, or write the times with all digits and in the right unit"
            raise DataError(source, problem, remedy if time == ahead else "sort the poses by time")
        bad = ~poses.isfinite().flatten(1).all(1)
        if bad.any():
            raise DataError(source, f"pose {int(bad.nonzero()[0])} is not finite", "drop it or interpolate it")
        distance = poses[..., 3].abs().max()
        if distance > _MAX_POSITION:
            raise DataError(source, f"a pose is {float(distance):g} away from the origin", "check the columns")
        require_rigid(poses, source)
        self.times: Tensor = nn.Buffer(times, persistent=False)
        self.camera_to_worlds: Tensor = nn.Buffer(poses, persistent=False)
        self._knots: Tensor = nn.Buffer(seconds, persistent=False)
        self._polynomials: Tensor = nn.Buffer(pose_polynomials(seconds, poses), persistent=False)
        self._products: Tensor = nn.Buffer(rotation_from_products().to(poses.device), persistent=False)

    def __len__(self) -> int:
        return len(self.times)

    @property
    def start(self) -> int:
        """Time of the first knot in nanoseconds."""
        return int(self.times[0])

    @property
    def end(self) -> int:
        """Time of the last knot in nanoseconds."""
        return int(self.times[-1])

    @property
    def duration(self) -> float:
        """Seconds from the first knot to the last."""
        return (self.end - self.start) * 1e-9

    @property
    def extent(self) -> float:
        """Root mean square distance of the positions at the knots from their mean."""
        positions = self.camera_to_worlds[:, :, 3]
        return float((positions - positions.mean(0)).square().sum(-1).mean().sqrt())

    def seconds(self, times: Tensor) -> Tensor:
        """Return the float64 seconds since ``start`` of integer times in nanoseconds."""
        return _to_seconds(times - self.times[0])

    def pose(self, seconds: Tensor) -> Tensor:
        """Return the poses at times inside the span, differentiable with respect to time.

        They are exact at the knots. Times are not checked against the span, because the check would stall a GPU:
        :meth:`interpolate` checks them.

        Args:
            seconds: (...) float64 seconds since ``start``.

        Returns:
            (..., 3, 4) float64 camera-to-world poses.
        """
        (c0, c1, c2, c3), time = self._locate(seconds)
        value = torch.addcmul(c0, time, torch.addcmul(c1, time, torch.addcmul(c2, time, c3)))
        position, quaternion = value.split((3, 4), -1)
        unit = quaternion / quaternion.norm(dim=-1, keepdim=True)
        rotation = (unit[..., None] * unit[..., None, :]).flatten(-2) @ self._products
        return torch.cat([rotation.unflatten(-1, (3, 3)), position[..., None]], -1)

    def pose_and_rate(self, seconds: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of :meth:`pose` and their derivatives with respect to time.

        The closed form costs a fraction of differentiating :meth:`pose`. The rate jumps at the ends of a gap, and there
        it is the rate after the knot.

        Args:
            seconds: (...) float64 seconds since ``start``.

        Returns:
            (..., 3, 4) float64 poses and (..., 3, 4) float64 rates per second.
        """
        (c0, c1, c2, c3), time = self._locate(seconds)
        # Horner's scheme, which gives the derivative on the way.
        b2 = torch.addcmul(c2, time, c3)
        b1 = torch.addcmul(c1, time, b2)
        position, quaternion = torch.addcmul(c0, time, b1).split((3, 4), -1)
        velocity, rate = torch.addcmul(b1, time, torch.addcmul(b2, time, c3)).split((3, 4), -1)
        length = quaternion.norm(dim=-1, keepdim=True)
        unit, rate = quaternion / length, rate / length
        # The rotation depends on the direction of the quaternion only.
        rate = torch.addcmul(rate, (unit * rate).sum(-1, keepdim=True), unit, value=-1)
        # The rotation is quadratic in the unit quaternion, hence the 2.
        products = torch.stack([unit, 2 * rate], -2)[..., None] * unit[..., None, None, :]
        rotation, turning = (products.flatten(-2) @ self._products).unflatten(-1, (3, 3)).unbind(-3)
        return torch.cat([rotation, position[..., None]], -1), torch.cat([turning, velocity[..., None]], -1)

    def _locate(self, seconds: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        """Return the four coefficients (..., 7) of the segments that times (...) lie in, and the time in them.

        The times in the segments are (..., 1), in seconds.
        """
        # The inner knots bound the segments: a time at the last knot lies in the last segment.
        segment = torch.searchsorted(self._knots[1:-1], seconds.detach(), right=True)
        return self._polynomials[segment].unbind(-2), (seconds - self._knots[segment])[..., None]

    def interpolate(self, times: ArrayLike | Tensor) -> Tensor:
        """Return the poses at given times.

        Args:
            times: (...) integer times in nanoseconds.

        Returns:
            (..., 3, 4) float64 camera-to-world poses.

        Raises:
            DataError: a time lies outside the span of the knots.
        """
        times = _as_times(times).to(self.times.device)
        outside = (times < self.start) | (times > self.end)
        if outside.any():
            first = int(times[outside].flatten()[0])
            problem = f"no pose at {first} ns, outside the trajectory's {self.start} to {self.end} ns"
            raise DataError(self.source, problem, "leave out what lies outside, or give poses that cover it")
        return self.pose(self.seconds(times))

    def crop(self, start: int, end: int) -> Trajectory:
        """Return the shortest run of knots that covers as much of [start, end] (nanoseconds) as the trajectory does.

        The poses within the part are those of the whole trajectory.

        Raises:
            DataError: the trajectory and the interval do not overlap.
        """
        first = max(int(torch.searchsorted(self.times, start, right=True)) - 1, 0)
        last = min(int(torch.searchsorted(self.times, end)), len(self) - 1)
        if start > self.end or end < self.start or first >= last:
            problem = f"its poses from {self.start} to {self.end} ns do not overlap the events from {start} to {end} ns"
            raise DataError(self.source, problem, "check that events and poses share one clock and one unit of time")
        part = Trajectory(self.times[first : last + 1], self.camera_to_worlds[first : last + 1], self.source)
        part._polynomials = self._polynomials[first:last]
        return part

    def known_time(self, longest_gap: int | None = None) -> TimeWindow:
        """Return the time in which poses are known: the span of the knots, without the gaps.

        Args:
            longest_gap: nanoseconds. Between two knots that are further apart the poses are not known. None: they are
                known everywhere.
        """
        return self._time_without(self.times.diff() > longest_gap if longest_gap is not None else None)

    def time_without_gaps(self) -> TimeWindow:
        """Return the span of the knots without its gaps.

        Gaps are the segments that the spline does not cross, if they are longer than twice the median: times may
        tremble.
        """
        steps = self.times.diff().double()
        return self._time_without(is_gap(steps) & (steps > 2 * steps.median()))

    def _time_without(self, gaps: Tensor | None) -> TimeWindow:
        """Return the span of the knots without some of the (N - 1,) segments."""
        found = [] if gaps is None else gaps.nonzero()[:, 0].tolist()
        return TimeWindow(self.start, self.end, tuple((int(self.times[i]), int(self.times[i + 1])) for i in found))

    def knots_between(self, start: int, end: int) -> Tensor:
        """Return the times in nanoseconds of the knots from ``start`` to ``end``, both included."""
        return self.times[(self.times >= start) & (self.times <= end)]

    def knots_known_to(self, reference: Trajectory) -> Tensor:
        """Return the times in nanoseconds of the knots in a reference trajectory's :meth:`time_without_gaps`."""
        return self.times[torch.from_numpy(reference.time_without_gaps().contains(self.times.cpu().numpy()))]

    def knots_covered_by(self, reference: Trajectory) -> Tensor:
        """Return :meth:`knots_known_to` a reference trajectory.

        Raises:
            DataError: there are fewer than two such knots.
        """
        times = self.knots_known_to(reference)
        if len(times) < 2:
            raise DataError(
                reference.source,
                f"its poses from {reference.start} to {reference.end} ns, without their gaps, do not cover two of the "
                f"estimated ones, from {self.start} to {self.end} ns",
                "give ground truth on the clock of the estimated poses, or remove the file",
            )
        return times

    def transform(self, function) -> Trajectory:
        """Return the trajectory with ``function`` applied to its (N, 4, 4) float64 camera-to-world matrices.

        The poses between the knots follow from the transformed knots. They do not depend on knots that :meth:`crop` has
        cut off, so transform before you crop.
        """
        return Trajectory(self.times, function(homogeneous(self.camera_to_worlds)), self.source)


def _as_times(times: ArrayLike | Tensor) -> Tensor:
    # NumPy cannot read a tensor on a GPU, and torch does not take a list of NumPy's integers.
    return torch.as_tensor(times if isinstance(times, Tensor) else np.asarray(times), dtype=torch.int64)


def _to_seconds(nanoseconds: Tensor) -> Tensor:
    return nanoseconds.to(torch.float64) * 1e-9


def require_rigid(poses: Tensor, source: str | Path) -> None:
    """Raise a DataError unless the (N, 3 or 4, 4) poses are rotations and translations."""
    rotations = poses[:, :3, :3]
    error = (rotations @ rotations.mT - torch.eye(3, dtype=poses.dtype, device=poses.device)).abs().amax((1, 2))
    error = torch.maximum(error, (torch.linalg.det(rotations) - 1).abs())
    if poses.shape[1] == 4:
        error = torch.maximum(error, (poses[:, 3] - poses.new_tensor([0, 0, 0, 1])).abs().amax(1))
    # Also if it is not a number.
    if not error.max() <= _MAX_RIGIDITY_ERROR:
        problem = f"pose {int(error.argmax())} is not a rigid motion (it is off by {float(error.max()):.2g})"
        raise DataError(source, problem, "give rotations without scale or reflection, and a last row of 0 0 0 1")


def homogeneous(poses: Tensor) -> Tensor:
    """Return the (..., 4, 4) matrices of (..., 3, 4) poses."""
    bottom = torch.zeros_like(poses[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([poses, bottom], -2)
