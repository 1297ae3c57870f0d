"""The contrast of events that are warped to one view, which tells whether poses and intrinsics fit the events.

Warping moves each event to where the reference view sees the event's edge. The pose at the event's time and the depth
of the edge give the place. With right poses and the right depth, the events of an edge then lie on one line. With wrong
poses they are smeared at every depth.

Contrast maximisation is by Gallego et al. 2018, "A unifying contrast maximization framework"; planes of different depth
are by Rebecq et al. 2018, "EMVS".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.checking.hypotheses import (
    ALTERNATIVES,
    CLOCK_OFFSETS,
    GIVEN,
    REFINEMENTS,
    STILL,
    Comparison,
    Hypothesis,
    clock_hypothesis,
)
from aenerf_ns.events.event_images import TILE, accumulate, best_of, image_size, tile_contrast
from aenerf_ns.events.stream import EventStream

# From one depth to the next, events at the ends of a slice move by this many pixels.
_DEPTH_STEP = 1.5
# Poses within a slice. From one to the next, nothing moves visibly.
_POSES = 96
# At most this many events of a slice are warped: more do not change the result.
_MAX_EVENTS = 40_000
# Numbers of events a pixel in a slice. They are tried in turn, until the image without warping is smeared.
_DENSITIES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
# An image of less contrast is smeared.
_SMEARED = 0.05
_NUM_SLICES = 8
# A slice is cut to the events that have a pose and a direction under both hypotheses. If a smaller share of the events
# is left, the slice is not compared.
_MIN_USABLE = 0.5
# An alternative is first tried on a third of the slices. If its contrast is not above this share of the given contrast,
# it is not tried on the others.
_HOPELESS = 0.85
# The columns of the events that are permuted together, and how often.
_SHUFFLED, _NUM_SHUFFLES = (("p",), ("x", "y"), ("x", "y", "p")), 2


@dataclass(frozen=True)
class WarpedSlice:
    """The image of a slice of events, warped to the pose in the middle of the slice.

    Each of the (R, C) tiles of the image is warped at the depth that gives the tile most contrast.

    Attributes:
        energy: (R, C) squared contrast of the tiles, less the squared contrast of noise.
        brightness: (R, C) squared brightness of the tiles.
        depth: (R, C) depth of the tiles along the optical axis of the reference view, in the unit of the poses;
            infinite where the tile does not move when the camera is translated.
        points: (R, C, 3) centres of the tiles in the world of the poses; not finite where the depth is infinite.
    """

    energy: NDArray[np.float64]
    brightness: NDArray[np.float64]
    depth: NDArray[np.float64]
    points: NDArray[np.float64]

    @property
    def contrast(self) -> float:
        """Relative squared contrast of edges: energy by brightness.

        It is 0 for noise in a tile at one depth. The best of many depths gives noise a contrast of about 0.1.
        """
        return _contrast([self])


def num_slices(num_events: int, camera: CameraIntrinsics) -> int:
    """Return how many runs of :func:`slice_size` events are taken from a recording.

    A short recording is one run, with all its events.
    """
    return 1 if num_events <= _NUM_SLICES * slice_size(camera) else _NUM_SLICES


def slice_size(camera: CameraIntrinsics) -> int:
    """Return the largest number of events in a slice."""
    width, height, _ = image_size(camera.width, camera.height)
    return int(_DENSITIES[-1] * width * height)


class WarpedEvents:
    """Warp slices of a recording under hypotheses about its poses, clock and pixels.

    Args:
        runs: runs of consecutive events within the span of the poses, in the order of time.
        trajectory: given poses of the event camera, camera-to-world, OpenCV camera axes.
        camera: lens of the event camera.
        seed: seed of the choice of events in long slices, and of the position of each event within its pixel.

    Attributes:
        given: the slices, warped by the given poses.
    """

    def __init__(
        self, runs: list[EventStream], trajectory: Trajectory, camera: CameraIntrinsics, seed: int = 0
    ) -> None:
        self._trajectory = trajectory
        self._width, self._height, self._binning = image_size(camera.width, camera.height)
        self._camera = camera
        directions, valid = camera.pixel_directions()
        depth = np.where(valid & (directions[..., 2] < -0.05), -directions[..., 2], np.nan)[..., None]
        self._plane = directions[..., :2] * [1, -1] / depth
        self._seed = seed
        rng = np.random.default_rng(seed)
        self._jitter = rng.uniform(-0.5, 0.5, (_MAX_EVENTS, 2)) / [camera.fx, camera.fy]
        self._slices = self._cut(runs, rng)
        self.given = [self._warp(events, GIVEN) for events in self._slices]

    def _cut(self, runs: list[EventStream], rng: np.random.Generator) -> list[EventStream]:
        """Return slices of the runs, so long that an image without warping is smeared."""
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
            if _contrast([self._warp(events, STILL) for events in slices]) < _SMEARED:
                break
        return slices

    @property
    def seconds(self) -> list[float]:
        """Duration of each slice in seconds."""
        return [float(events.t[-1] - events.t[0]) * 1e-9 for events in self._slices]

    @property
    def spans(self) -> list[tuple[int, int]]:
        """Times of the first and the last event of each slice in nanoseconds."""
        return [(int(events.t[0]), int(events.t[-1])) for events in self._slices]

    def compare(self, hypothesis: Hypothesis, slices: slice = slice(None)) -> Comparison | None:
        """Compare the contrast under a hypothesis with the given contrast, over the same events.

        Args:
            hypothesis: the hypothesis.
            slices: which slices of events to compare; by default all.

        Returns:
            The comparison, or None if too few events have a pose and a direction under the hypothesis.
        """
        covered = TimeWindow(self._trajectory.start, self._trajectory.end)
        given, alternative, numbers = [], [], []
        has_direction = np.isfinite(hypothesis.plane(self._plane) + self._plane).all(-1)
        for number in range(len(self._slices))[slices]:
            events, as_given = self._slices[number], self.given[number]
            seen = has_direction[events.y, events.x]
            usable = seen & covered.contains(events.t + hypothesis.clock_offset)
            if usable.sum() < max(_MIN_USABLE * seen.sum(), 2):
                continue
            part = events[usable]
            given.append(as_given if usable.all() else self._warp(part, GIVEN))
            alternative.append(self._warp(part, hypothesis))
            numbers.append(number)
        if not given:
            return None
        alone = [_compared(hypothesis, [one], [other]) for one, other in zip(given, alternative, strict=True)]
        clear = [number for number, one in zip(numbers, alone, strict=True) if one.is_clearly_better]
        return replace(_compared(hypothesis, given, alternative), clear_slices=frozenset(clear))

    def comparisons(self) -> list[Comparison]:
        """Compare all alternatives whose events the poses cover, and return the comparisons, the best first.

        An alternative that is much worse than what is given in a third of the slices is not tried on the others. The
        best clock offset is refined.
        """
        offsets = [round(sign * seconds * 1e9) for seconds in CLOCK_OFFSETS for sign in (-1, 1)]
        found = []
        for hypothesis in (*ALTERNATIVES, *map(clock_hypothesis, offsets)):
            comparison = self.compare(hypothesis, slice(None, None, 3))
            if comparison is not None and comparison.contrast > _HOPELESS * comparison.given:
                comparison = self.compare(hypothesis)
            if comparison is not None:
                found.append(comparison)
        clocks = [c for c in found if c.hypothesis.clock_offset and c.is_clearly_better]
        if clocks:
            best = max(clocks, key=lambda c: c.contrast - c.given).hypothesis.clock_offset
            between = [self.compare(clock_hypothesis(round(best * factor))) for factor in REFINEMENTS]
            found += [comparison for comparison in between if comparison is not None]
        return sorted(found, key=lambda c: c.contrast - c.given, reverse=True)

    def without_motion(self) -> Comparison:
        """Compare the contrast without any warping with the given contrast."""
        comparison = self.compare(STILL)
        assert comparison is not None
        return comparison

    def shuffled(self) -> NDArray[np.float64]:
        """Return the contrasts of the same events under the given poses, after their order was lost.

        Within each slice the polarities, the pixels, or both are permuted, which is to permute the times. What contrast
        is left, noise has too.
        """
        rng = np.random.default_rng(self._seed)
        contrasts = []
        for columns in _SHUFFLED * _NUM_SHUFFLES:
            permuted = []
            for events in self._slices:
                order = rng.permutation(len(events))
                permuted.append(replace(events, **{name: getattr(events, name)[order] for name in columns}))
            contrasts.append(_contrast([self._warp(events, GIVEN) for events in permuted]))
        return np.array(contrasts)

    def _prepared(self, events: EventStream, hypothesis: Hypothesis) -> tuple:
        """Return what :func:`_lines` and :func:`accumulate` need, for a slice under a hypothesis.

        Returns:
            (N, 2) directions of the events on the plane at depth 1, (N,) their polarities, (N,) the indices of their
            poses, the (P, 3, 4) poses relative to the pose in the middle, (4,) fx fy cx cy of the images, and the
            (4, 4) pose in the middle.
        """
        camera = self._camera
        times = np.linspace(events.t[0], events.t[-1], _POSES).astype(np.int64)
        if hypothesis.still:
            poses = torch.eye(4, dtype=torch.float64).expand(_POSES, 4, 4)
        else:
            trajectory = self._trajectory.transform(hypothesis.poses)
            poses = homogeneous(trajectory.interpolate(times + hypothesis.clock_offset))
        reference = poses[_POSES // 2]
        relative = np.ascontiguousarray((torch.linalg.inv(reference) @ poses)[:, :3].numpy())
        duration = max(int(events.t[-1] - events.t[0]), 1)
        index = np.rint((events.t - events.t[0]) / duration * (_POSES - 1)).astype(np.int64)
        points = hypothesis.plane(self._plane)[events.y, events.x] + self._jitter[: len(events)]
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy]) / self._binning
        return points, events.p.astype(np.float32), index, relative, intrinsics, reference

    def _warp(self, events: EventStream, hypothesis: Hypothesis) -> WarpedSlice:
        """Warp a slice at every depth, and keep the depth of most contrast in each tile."""
        points, polarity, index, relative, intrinsics, reference = self._prepared(events, hypothesis)
        lines = _lines(points, index, relative, intrinsics)
        baseline = float(np.linalg.norm(relative[:, :, 3], axis=1).max())
        inverse_depths = np.zeros(1)
        if baseline > 0:
            steps = np.arange(0, self._width / _DEPTH_STEP + 1)
            inverse_depths = steps * _DEPTH_STEP / (intrinsics[0] * baseline)
        net, total = np.zeros((2, self._height, self._width), np.float32)
        measured = []
        for inverse_depth in inverse_depths:
            accumulate(lines, polarity, np.float32(inverse_depth), net, total)
            measured.append(tile_contrast(net, total))
        energy, brightness = map(np.array, zip(*measured, strict=True))
        best = best_of(energy, brightness)
        with np.errstate(divide="ignore"):
            depth = 1 / inverse_depths[best]
        rows, columns = (np.arange(n) * TILE + TILE / 2 for n in best.shape)
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
        """Return the slice with the most contrast as it came and warped, side by side.

        Returns:
            (height, 2 width) number of positive events less that of negative events. In the right half, each tile is
            warped at its depth.
        """
        best = max(range(len(self.given)), key=lambda i: self.given[i].contrast)
        events, depth = self._slices[best], self.given[best].depth
        points, polarity, index, relative, intrinsics, _ = self._prepared(events, GIVEN)
        shape = (self._height, self._width)
        net, total = np.zeros((2, *shape), np.float32)
        depth_of_pixel = np.kron(depth, np.ones((TILE, TILE)))
        still = np.tile(np.eye(3, 4), (_POSES, 1, 1))
        accumulate(_lines(points, index, still, intrinsics), polarity, np.float32(0), net, total)
        lines = _lines(points, index, relative, intrinsics)
        unwarped, warped = net.copy(), np.zeros(shape, np.float32)
        for value in np.unique(depth):
            accumulate(lines, polarity, np.float32(1 / value), net, total)
            warped[depth_of_pixel == value] = net[depth_of_pixel == value]
        return np.concatenate([unwarped, warped], 1)


def _contrast(slices: Sequence[WarpedSlice]) -> float:
    """Return the contrast of all tiles of the slices together."""
    return float(sum(s.energy.sum() for s in slices) / max(sum(s.brightness.sum() for s in slices), 1e-30))


def _compared(hypothesis: Hypothesis, given: list[WarpedSlice], alternative: list[WarpedSlice]) -> Comparison:
    """Compare slices that are warped under a hypothesis with the same slices warped as given."""
    # The standard error of the difference of two ratios of sums, over the tiles.
    error = np.sqrt(
        sum(
            np.square(_residuals(other, alternative) - _residuals(one, given)).sum()
            for one, other in zip(given, alternative, strict=True)
        )
    )
    difference = (_contrast(alternative) - _contrast(given)) / max(float(error), 1e-12)
    return Comparison(hypothesis, _contrast(alternative), _contrast(given), difference)


def _residuals(one: WarpedSlice, slices: Sequence[WarpedSlice]) -> NDArray[np.float64]:
    """Return by how much each (R, C) tile of one slice raises the contrast of all slices, to first order."""
    return (one.energy - _contrast(slices) * one.brightness) / max(sum(s.brightness.sum() for s in slices), 1e-30)


@numba.njit(cache=True)
def _lines(points, index, relative, intrinsics):
    """Return where the reference view sees the events on a plane, as a function of the depth of the plane.

    The event is seen at u = u0 + u1 / depth, v = v0 + v1 / depth if w / depth < 1.

    Returns:
        (5, N) float32 of u0, u1, v0, v1, w; NaN where an event is behind the reference view.
    """
    lines = np.empty((5, points.shape[0]), np.float32)
    fx, fy, cx, cy = intrinsics
    for i in range(points.shape[0]):
        k = index[i]
        a, b = points[i, 0], points[i, 1]
        x = relative[k, 0, 0] * a + relative[k, 0, 1] * b + relative[k, 0, 2]
        y = relative[k, 1, 0] * a + relative[k, 1, 1] * b + relative[k, 1, 2]
        z = relative[k, 2, 0] * a + relative[k, 2, 1] * b + relative[k, 2, 2]
        if z > 1e-3:
            # The ray (x, y, z) from the camera's position at the event meets the plane at depth / z (1 - w / depth).
            lines[0, i] = fx * x / z + cx
            lines[1, i] = fx * (relative[k, 0, 3] - relative[k, 2, 3] * x / z)
            lines[2, i] = fy * y / z + cy
            lines[3, i] = fy * (relative[k, 1, 3] - relative[k, 2, 3] * y / z)
            lines[4, i] = relative[k, 2, 3]
        else:
            lines[:, i] = np.nan
    return lines
