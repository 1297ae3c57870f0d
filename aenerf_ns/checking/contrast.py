"""Whether poses and intrinsics fit the events: the contrast of events that are warped to one view.

The events of an edge lie on one line when each is moved to where the pose of its time says that the edge is seen from a
reference pose, at the right depth (Gallego et al. 2018, "A unifying contrast maximization framework"; the planes of
different depth are those of Rebecq et al. 2018, "EMVS"). With wrong poses they are smeared at every depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.lens import EventCamera
from aenerf_ns.camera.rotation import quaternion_from_rotation, rotation_from_quaternion
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.events.stream import EventStream

# The images of warped events are at most this wide: larger sensors are binned.
_MAX_WIDTH = 240
# Side of the tiles that each have a depth of their own, in pixels of these images.
_TILE = 16
# Edges are the difference between the image smoothed by a Gaussian of this standard deviation and by two boxes of this
# width, which are about a Gaussian of 2.8 pixels.
_FINE, _COARSE = 0.7, 7
# Between two depths, events at the ends of a slice move by this many pixels.
_DEPTH_STEP = 1.5
# Poses within a slice; between them nothing moves visibly.
_POSES = 96
# Events of a slice that are warped: more do not change the result.
_MAX_EVENTS = 40_000
# Events a pixel in the slices that are tried, until what moves is smeared where nothing is warped.
_DENSITIES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
_SMEARED = 0.05
_NUM_SLICES = 8
# A slice is cut to the events that have a pose and a direction under both hypotheses, unless less than this is left.
_MIN_USABLE = 0.5
# An alternative with less than this share of the given contrast in a third of the slices is not tried on the others.
_HOPELESS = 0.85

# One contrast is clearly higher than another by so many standard errors and so large a factor: either of these.
_CLEAR = ((4.0, 1.03), (2.5, 1.15))
# What differs by less cannot be told apart.
_SAME_ERRORS, _SAME_FACTOR = 2.0, 1.03

_CLOCK_OFFSETS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
# Between these.
_REFINEMENTS = (0.6, 0.7, 0.8, 0.9, 1.2, 1.4, 1.7)


def _axes(*signs: float) -> Callable[[Tensor], Tensor]:
    matrix = torch.diag(torch.tensor([*signs, 1.0], dtype=torch.float64))
    return lambda poses: poses @ matrix


def _quaternions_with_w_first(poses: Tensor) -> Tensor:
    """What was meant by qw qx qy qz where it was read as qx qy qz qw."""
    quaternion = quaternion_from_rotation(poses[:, :3, :3]).roll(-1, -1)
    return homogeneous(torch.cat([rotation_from_quaternion(quaternion), poses[:, :3, 3:]], -1))


def _transposed(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """The grid with rows and columns exchanged, NaN where that leaves the sensor."""
    side = min(plane.shape[:2])
    swapped = np.full_like(plane, np.nan)
    swapped[:side, :side] = plane[:side, :side].transpose(1, 0, 2)
    return swapped


def _same(value):
    return value


@dataclass(frozen=True)
class Hypothesis:
    """What poses, clock or pixels might mean in place of what is said.

    Attributes:
        name: what would then be wrong with the dataset, to be read after "as if".
        remedy: what to do about it.
        poses: takes the given (N, 4, 4) poses to those meant.
        plane: takes the (height, width, 2) grid of directions to that of the pixels meant.
        clock_offset: nanoseconds to be added to the time of an event before its pose is looked up.
        still: whether the camera does not move.
    """

    name: str
    remedy: str = ""
    poses: Callable[[Tensor], Tensor] = _same
    plane: Callable[[NDArray[np.float64]], NDArray[np.float64]] = _same
    clock_offset: int = 0
    still: bool = False


GIVEN = Hypothesis("as given")
_STILL = Hypothesis("the camera did not move", still=True)

_ALTERNATIVES = (
    Hypothesis(
        "the poses have OpenGL camera axes (y up, z backward)",
        "multiply each camera-to-world matrix by diag(1, -1, -1, 1) from the right",
        poses=_axes(1, -1, -1),
    ),
    Hypothesis(
        "the camera axes x and y are flipped (a camera upside down)",
        "multiply each camera-to-world matrix by diag(-1, -1, 1, 1) from the right",
        poses=_axes(-1, -1, 1),
    ),
    Hypothesis(
        "the camera axes x and z are flipped",
        "multiply each camera-to-world matrix by diag(-1, 1, -1, 1) from the right",
        poses=_axes(-1, 1, -1),
    ),
    Hypothesis("the poses are world-to-camera", "invert each: rotation R^T, position -R^T t", poses=torch.linalg.inv),
    Hypothesis(
        "the poses are world-to-camera with OpenGL camera axes",
        "invert each and multiply it by diag(1, -1, -1, 1) from the right",
        poses=lambda poses: _axes(1, -1, -1)(torch.linalg.inv(poses)),
    ),
    Hypothesis("the quaternions have w first", "write them as qx qy qz qw", poses=_quaternions_with_w_first),
    Hypothesis("the pixels are mirrored in x", "write x as width - 1 - x", plane=lambda plane: plane[:, ::-1]),
    Hypothesis("the pixels are mirrored in y", "write y as height - 1 - y", plane=lambda plane: plane[::-1]),
    Hypothesis("x and y of the events are swapped", "swap the two columns", plane=_transposed),
)


def clock_hypothesis(offset: int) -> Hypothesis:
    """The poses' clock is off: the pose of an event at time t is that at t + offset (nanoseconds)."""
    seconds, is_ahead = f"{abs(offset) * 1e-9:g} s", offset > 0
    return Hypothesis(
        f"the clock of the poses is {seconds} {'ahead of' if is_ahead else 'behind'} that of the events",
        f"{'subtract' if is_ahead else 'add'} {seconds} {'from' if is_ahead else 'to'} the times of the poses",
        clock_offset=offset,
    )


@dataclass(frozen=True)
class WarpedSlice:
    """A slice of events, warped to the pose in its middle at the depth of each tile that gives most contrast.

    Attributes:
        energy: (R, C) squared contrast of the tiles, less what noise alone has.
        brightness: (R, C) squared brightness of the tiles, by which it is measured.
        depth: (R, C) depth of the tiles along the optical axis of the reference view, in the poses' unit; infinite
            where they do not move as the camera does.
        points: (R, C, 3) middles of the tiles in the world; not finite where the depth is infinite.
    """

    energy: NDArray[np.float64]
    brightness: NDArray[np.float64]
    depth: NDArray[np.float64]
    points: NDArray[np.float64]

    @property
    def contrast(self) -> float:
        """Relative squared contrast of edges, 0 where there is only noise."""
        return float(self.energy.sum() / max(self.brightness.sum(), 1e-30))


@dataclass(frozen=True)
class Comparison:
    """An alternative beside what is given, over the same events.

    Attributes:
        hypothesis: the alternative.
        contrast: its contrast.
        given: the contrast of what is given.
        difference: of the two, in standard errors over the tiles.
    """

    hypothesis: Hypothesis
    contrast: float
    given: float
    difference: float

    @property
    def is_clearly_better(self) -> bool:
        return _is_clear(self.difference, self.contrast, self.given)

    @property
    def is_clearly_worse(self) -> bool:
        return _is_clear(-self.difference, self.given, self.contrast)

    @property
    def is_untold(self) -> bool:
        """Whether it fits about as well as what is given."""
        return abs(self.difference) < _SAME_ERRORS and _about_equal(self.contrast, self.given)

    def is_like(self, other: Comparison) -> bool:
        """Whether it fits about as well as another alternative."""
        return _about_equal(self.contrast, other.contrast)


def _is_clear(difference: float, higher: float, lower: float) -> bool:
    return any(difference > errors and higher > factor * max(lower, 0) for errors, factor in _CLEAR)


def _about_equal(one: float, other: float) -> bool:
    return abs(one - other) < (_SAME_FACTOR - 1) * max(one, other)


def num_slices(num_events: int, camera: EventCamera) -> int:
    """Into how many runs, each of :func:`slice_size` events, a recording is cut: one, all of it, when it is short."""
    return 1 if num_events <= _NUM_SLICES * slice_size(camera) else _NUM_SLICES


def slice_size(camera: EventCamera) -> int:
    """The most events of a slice that are looked at."""
    width, height, _ = _image_size(camera)
    return int(_DENSITIES[-1] * width * height)


def _image_size(camera: EventCamera) -> tuple[int, int, int]:
    """Width and height, in whole tiles, of the images of warped events, and the sensor's pixels to one of theirs."""
    binning = -(-camera.width // _MAX_WIDTH)
    width, height = (-(-size // (binning * _TILE)) * _TILE for size in (camera.width, camera.height))
    return width, height, binning


class WarpedEvents:
    """Slices of a recording, and what they look like under hypotheses on its poses, clock and pixels.

    Args:
        runs: runs of consecutive events within the span of the poses, in the order of time.
        trajectory: given poses of the event camera, camera-to-world, OpenCV camera axes.
        camera: its lens.
        seed: of the events that are left out, and of where within its pixel an event is taken to be.
    """

    def __init__(self, runs: list[EventStream], trajectory: Trajectory, camera: EventCamera, seed: int = 0) -> None:
        self._trajectory = trajectory
        self._width, self._height, self._binning = _image_size(camera)
        self._camera = camera
        directions, valid = camera.pixel_directions()
        depth = np.where(valid & (directions[..., 2] < -0.05), -directions[..., 2], np.nan)[..., None]
        self._plane = directions[..., :2] * [1, -1] / depth
        rng = np.random.default_rng(seed)
        self._jitter = rng.uniform(-0.5, 0.5, (_MAX_EVENTS, 2)) / [camera.fx, camera.fy]
        self._slices = self._cut(runs, rng)
        self._given = [self._warp(events, GIVEN) for events in self._slices]

    def _cut(self, runs: list[EventStream], rng: np.random.Generator) -> list[EventStream]:
        """Slices so long that an image without warping is smeared."""
        for density in _DENSITIES:
            size = int(density * self._width * self._height)
            slices = []
            for run in runs:
                count = min(max(len(run) // size, 1), _NUM_SLICES // len(runs))
                length = len(run) if len(run) < 2 * size else size
                for begin in (np.arange(count) + 0.5) / count * (len(run) - length):
                    events = run[int(begin) : int(begin) + length]
                    if len(events) > _MAX_EVENTS:
                        events = events[np.sort(rng.choice(len(events), _MAX_EVENTS, replace=False))]
                    slices.append(events)
            if _contrast([self._warp(events, _STILL) for events in slices]) < _SMEARED:
                break
        return slices

    @property
    def seconds(self) -> list[float]:
        """Duration of each slice."""
        return [float(events.t[-1] - events.t[0]) * 1e-9 for events in self._slices]

    @property
    def given(self) -> list[WarpedSlice]:
        """The slices with what is given."""
        return self._given

    def compare(self, hypothesis: Hypothesis, step: int = 1) -> Comparison | None:
        """An alternative beside what is given; None where the poses do not cover what it needs.

        Args:
            hypothesis: the alternative.
            step: take only every so many slices.
        """
        given, alternative = [], []
        has_direction = np.isfinite(hypothesis.plane(self._plane) + self._plane).all(-1)
        for events, as_given in list(zip(self._slices, self._given, strict=True))[::step]:
            times = events.t + hypothesis.clock_offset
            seen = has_direction[events.y, events.x]
            usable = seen & (times >= self._trajectory.start) & (times <= self._trajectory.end)
            if usable.sum() < max(_MIN_USABLE * seen.sum(), 2):
                continue
            part = events[usable]
            given.append(as_given if usable.all() else self._warp(part, GIVEN))
            alternative.append(self._warp(part, hypothesis))
        if not given:
            return None
        # The standard error of the difference of two ratios of sums, over the tiles.
        error = np.sqrt(
            sum(
                np.square(_residuals(other, alternative) - _residuals(one, given)).sum()
                for one, other in zip(given, alternative, strict=True)
            )
        )
        difference = (_contrast(alternative) - _contrast(given)) / max(float(error), 1e-12)
        return Comparison(hypothesis, _contrast(alternative), _contrast(given), difference)

    def comparisons(self) -> list[Comparison]:
        """All alternatives that the poses cover, the best first; the best clock offset refined.

        Those that are worse in a third of the slices are not looked at in the others.
        """
        offsets = [round(sign * seconds * 1e9) for seconds in _CLOCK_OFFSETS for sign in (-1, 1)]
        found = []
        for hypothesis in (*_ALTERNATIVES, *map(clock_hypothesis, offsets)):
            comparison = self.compare(hypothesis, step=3)
            if comparison is not None and comparison.contrast > _HOPELESS * comparison.given:
                comparison = self.compare(hypothesis)
            if comparison is not None:
                found.append(comparison)
        clocks = [c for c in found if c.hypothesis.clock_offset and c.is_clearly_better]
        if clocks:
            best = max(clocks, key=lambda c: c.contrast - c.given).hypothesis.clock_offset
            between = [self.compare(clock_hypothesis(round(best * factor))) for factor in _REFINEMENTS]
            found += [comparison for comparison in between if comparison is not None]
        return sorted(found, key=lambda c: c.contrast - c.given, reverse=True)

    def without_motion(self) -> Comparison:
        """The slices without any warping beside what is given."""
        comparison = self.compare(_STILL)
        assert comparison is not None
        return comparison

    def _prepared(self, events: EventStream, hypothesis: Hypothesis) -> tuple:
        """Directions (N, 2), polarities and indices of poses of the events, the poses (P, 3, 4) relative to the one in
        the middle, fx fy cx cy of the images, and the pose in the middle (4, 4)."""
        camera = self._camera
        times = np.linspace(events.t[0], events.t[-1], _POSES).astype(np.int64)
        if hypothesis.still:
            poses = torch.eye(4, dtype=torch.float64).expand(_POSES, 4, 4)
        else:
            trajectory = self._trajectory.mapped(hypothesis.poses)
            poses = homogeneous(trajectory.interpolate(times + hypothesis.clock_offset))
        reference = poses[_POSES // 2]
        relative = np.ascontiguousarray((torch.linalg.inv(reference) @ poses)[:, :3].numpy())
        duration = max(int(events.t[-1] - events.t[0]), 1)
        index = np.rint((events.t - events.t[0]) / duration * (_POSES - 1)).astype(np.int64)
        points = hypothesis.plane(self._plane)[events.y, events.x] + self._jitter[: len(events)]
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy]) / self._binning
        return points, events.p.astype(np.float32), index, relative, intrinsics, reference

    def _warp(self, events: EventStream, hypothesis: Hypothesis) -> WarpedSlice:
        points, polarity, index, relative, intrinsics, reference = self._prepared(events, hypothesis)
        lines = _lines(points, index, relative, intrinsics)
        baseline = float(np.linalg.norm(relative[:, :, 3], axis=1).max())
        inverse_depths = np.zeros(1)
        if baseline > 0:
            steps = np.arange(0, self._width / _DEPTH_STEP + 1)
            inverse_depths = steps * _DEPTH_STEP / (intrinsics[0] * baseline)
        net, total = np.zeros((2, self._height, self._width), np.float32)
        energies, brightnesses = [], []
        for inverse_depth in inverse_depths:
            _accumulate(lines, polarity, np.float32(inverse_depth), net, total)
            coarse, edges = _smooth(total), _edges(net)
            energies.append(_tile_sums(edges * edges - _noise_energy() * coarse))
            brightnesses.append(_tile_sums(coarse * coarse))
        energy, brightness = np.array(energies), np.array(brightnesses)
        # Not the ratio alone, or tiles would choose the depth that leaves them empty.
        best = (energy / (brightness + brightness.mean() + 1e-12)).argmax(0)
        with np.errstate(divide="ignore"):
            depth = 1 / inverse_depths[best]
        rows, columns = (np.arange(n) * _TILE + _TILE / 2 for n in best.shape)
        plane = np.stack(
            np.broadcast_arrays(
                ((columns - intrinsics[2]) / intrinsics[0])[None],
                ((rows - intrinsics[3]) / intrinsics[1])[:, None],
                1.0,
            ),
            -1,
        )
        with np.errstate(invalid="ignore"):
            in_world = (plane * depth[..., None]) @ reference[:3, :3].numpy().T + reference[:3, 3].numpy()
        return WarpedSlice(
            energy=np.take_along_axis(energy, best[None], 0)[0],
            brightness=np.take_along_axis(brightness, best[None], 0)[0],
            depth=depth,
            points=in_world,
        )

    def picture(self) -> NDArray[np.float32]:
        """(height, 2 width) positive less negative events of the slice with the most contrast: on the left as they
        came, on the right warped, each tile at its depth."""
        best = max(range(len(self._given)), key=lambda i: self._given[i].contrast)
        events, depth = self._slices[best], self._given[best].depth
        points, polarity, index, relative, intrinsics, _ = self._prepared(events, GIVEN)
        shape = (self._height, self._width)
        net, total = np.zeros((2, *shape), np.float32)
        depth_of_pixel = np.kron(depth, np.ones((_TILE, _TILE)))
        still = np.tile(np.eye(3, 4), (_POSES, 1, 1))
        _accumulate(_lines(points, index, still, intrinsics), polarity, np.float32(0), net, total)
        lines = _lines(points, index, relative, intrinsics)
        unwarped, warped = net.copy(), np.zeros(shape, np.float32)
        for value in np.unique(depth):
            _accumulate(lines, polarity, np.float32(1 / value), net, total)
            warped[depth_of_pixel == value] = net[depth_of_pixel == value]
        return np.concatenate([unwarped, warped], 1)


def _contrast(slices) -> float:
    return float(sum(s.energy.sum() for s in slices) / max(sum(s.brightness.sum() for s in slices), 1e-30))


def _residuals(one: WarpedSlice, slices) -> NDArray[np.float64]:
    """How the tiles of a slice pull at the ratio of all."""
    return (one.energy - _contrast(slices) * one.brightness) / max(sum(s.brightness.sum() for s in slices), 1e-30)


def _smooth(image: NDArray) -> NDArray:
    return cv2.blur(cv2.blur(image, (_COARSE, _COARSE)), (_COARSE, _COARSE))


def _edges(image: NDArray) -> NDArray:
    return cv2.GaussianBlur(image, (0, 0), _FINE) - _smooth(image)


@lru_cache(maxsize=1)
def _noise_energy() -> float:
    """Squared contrast that independent events have, for each of them."""
    impulse = np.zeros((41, 41), np.float32)
    impulse[20, 20] = 1
    return float(np.square(_edges(impulse)).sum())


def _tile_sums(image: NDArray) -> NDArray[np.float64]:
    height, width = image.shape
    return image.reshape(height // _TILE, _TILE, width // _TILE, _TILE).sum((1, 3), dtype=np.float64)


@numba.njit(cache=True)
def _lines(points, index, relative, intrinsics):
    """Where a plane of the reference view shows the events: at u = u0 + u1 / depth, v = v0 + v1 / depth, as long as
    1 > w / depth. (5, N) float32 of u0, u1, v0, v1, w; NaN where an event is behind the reference view."""
    lines = np.empty((5, points.shape[0]), np.float32)
    fx, fy, cx, cy = intrinsics
    for i in range(points.shape[0]):
        k = index[i]
        a, b = points[i, 0], points[i, 1]
        x = relative[k, 0, 0] * a + relative[k, 0, 1] * b + relative[k, 0, 2]
        y = relative[k, 1, 0] * a + relative[k, 1, 1] * b + relative[k, 1, 2]
        z = relative[k, 2, 0] * a + relative[k, 2, 1] * b + relative[k, 2, 2]
        if z > 1e-3:
            # The ray (x, y, z) from the event's place meets the plane at depth / z (1 - w / depth).
            lines[0, i] = fx * x / z + cx
            lines[1, i] = fx * (relative[k, 0, 3] - relative[k, 2, 3] * x / z)
            lines[2, i] = fy * y / z + cy
            lines[3, i] = fy * (relative[k, 1, 3] - relative[k, 2, 3] * y / z)
            lines[4, i] = relative[k, 2, 3]
        else:
            lines[:, i] = np.nan
    return lines


@numba.njit(cache=True)
def _accumulate(lines, polarity, inverse_depth, net, total):
    """Adds up the events' polarities and numbers where a plane at a depth of the reference view shows them.

    To the nearest pixel: interpolation between pixels would smooth the image by an amount that depends on the motion.
    """
    net[:] = 0
    total[:] = 0
    height, width = net.shape
    for i in range(lines.shape[1]):
        u = lines[0, i] + lines[1, i] * inverse_depth
        v = lines[2, i] + lines[3, i] * inverse_depth
        # NaN fails here too.
        if 0 <= u < width and 0 <= v < height and lines[4, i] * inverse_depth < 1:
            net[int(v), int(u)] += polarity[i]
            total[int(v), int(u)] += 1
