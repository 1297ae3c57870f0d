"""The contrast of events that are warped to one view, which says whether poses and intrinsics fit the events.

Warping moves each event to where the reference view sees the event's edge. The pose at the event's time and the depth
of the edge give the position. With right poses and the right depth, the events of an edge then lie on one line. With
wrong poses they are smeared at every depth.

Contrast maximization is by Gallego et al. 2018, "A unifying contrast maximization framework"; planes of different depth
are by Rebecq et al. 2018, "EMVS".
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

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
from aenerf_ns.events.event_images import TILE, accumulate, image_size, sharpest
from aenerf_ns.events.picture import net_picture
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_reader import EventFile

# Permuted together, these columns lose their order within a slice.
_SHUFFLED_COLUMNS = (("p",), ("x", "y"), ("x", "y", "p"))
_PICTURE_HEIGHT = 480

MIN_EVENTS = 2_000
"""Fewer events give no contrast."""

# Slices of a recording.
_NUM_SLICES = 8
# Events per pixel in a slice. They are tried in turn, until the image without warping is smeared.
_DENSITIES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
# An image of less contrast is smeared.
_SMEARED_CONTRAST = 0.05
# Events of a slice that are warped. More do not change the result.
_MAX_EVENTS = 40_000
# Poses within a slice. From one to the next, nothing moves visibly.
_NUM_POSES = 96
# Pixels that events at the ends of a slice move from one depth to the next.
_DEPTH_STEP = 1.5
# A slice is cut to the events that have a pose and a direction under both hypotheses. If a smaller share of the events
# is left, the slice is not compared.
_MIN_USABLE_SHARE = 0.5
# An alternative is first tried on a third of the slices. If its contrast is not above this share of the given
# contrast, it is not tried on the others.
_HOPELESS_SHARE = 0.85
# How often the events are shuffled in each of three ways.
_NUM_SHUFFLES = 2


@dataclass(frozen=True)
class WarpedSlice:
    """The image of a slice of events, warped to the pose in the middle of the slice.

    Each of the (R, C) tiles of the image is warped at the depth that gives the tile most contrast. The contrast of the
    slice is the sum of ``energy`` by the sum of ``brightness``. It is 0 for noise in a tile at one depth. The best of
    many depths gives noise a contrast of about 0.1.

    Attributes:
        energy: (R, C) squared contrast of the tiles, less the squared contrast of noise.
        brightness: (R, C) squared brightness of the tiles.
        depth: (R, C) depth of the tiles along the optical axis of the reference view, in the unit of the poses;
            infinite where the tile does not move when the camera is translated.
        points: (R, C, 3) centers of the tiles in the world of the poses; not finite where the depth is infinite.
    """

    energy: NDArray[np.float64]
    brightness: NDArray[np.float64]
    depth: NDArray[np.float64]
    points: NDArray[np.float64]


def read_runs(file: EventFile, camera: CameraIntrinsics, window: TimeWindow, num_covered: int) -> list[EventStream]:
    """Read the runs of consecutive events that are looked at, evenly spread over the events in a time window.

    The events of a slice are warped as one motion, which a gap between the poses would be in. So runs end at the gaps
    of the window, and are left out below MIN_EVENTS events.

    Args:
        file: the events.
        camera: intrinsics of the event camera.
        window: times that have poses.
        num_covered: number of events in the window.

    Returns:
        Runs as long as the longest slice, as many as there are slices at most, in the order of time; one run with all
        events of a short recording.

    Raises:
        DataError: the events cannot be read.
    """
    width, height, _ = image_size(camera.width, camera.height)
    begins, length = np.zeros(1, np.int64), num_covered
    if num_covered > _NUM_SLICES * int(_DENSITIES[-1] * width * height):
        length = int(_DENSITIES[-1] * width * height)
        begins = np.linspace(0, num_covered - length, _NUM_SLICES).astype(np.int64)
    parts: list[list[EventStream]] = [[] for _ in begins]
    position = 0
    for chunk in file.tracked("Choosing events"):
        covered = chunk[window.contains(chunk.t)]
        for part, begin in zip(parts, begins - position, strict=True):
            # Indices make a copy: a slice would keep the whole chunk in memory.
            part.append(covered[np.arange(len(covered))[max(begin, 0) : max(begin + length, 0)]])
        position += len(covered)
    runs = [EventStream.concatenate(part) for part in parts if part]
    stretches = [run.between(*piece) for run in runs for piece in window.pieces()]
    longest = sorted((part for part in stretches if len(part) >= MIN_EVENTS), key=len)[-_NUM_SLICES:]
    return sorted(longest, key=lambda part: part.t[0])


class WarpedEvents:
    """Warp slices of a recording under hypotheses about its poses, clock and pixels.

    Args:
        runs: runs of consecutive events within the span of the poses, in the order of time.
        trajectory: given poses of the event camera, camera-to-world, OpenCV camera axes.
        camera: intrinsics of the event camera.

    Attributes:
        given: the slices, warped by the given poses.
    """

    def __init__(self, runs: list[EventStream], trajectory: Trajectory, camera: CameraIntrinsics) -> None:
        self._trajectory = trajectory
        self._meant = {GIVEN.poses: trajectory}
        self._width, self._height, self._binning = image_size(camera.width, camera.height)
        self._camera = camera
        directions, valid = camera.pixel_directions()
        depth = np.where(valid & (directions[..., 2] < -0.05), -directions[..., 2], np.nan)[..., None]
        self._plane = directions[..., :2] * [1, -1] / depth
        # Chooses the events of long slices, and the position of each event within its pixel.
        rng = np.random.default_rng(0)
        self._jitter = rng.uniform(-0.5, 0.5, (_MAX_EVENTS, 2)) / [camera.fx, camera.fy]
        self._slices = self._cut(runs, rng)
        self.given = [self._warp(events, GIVEN) for events in self._slices]

    def _cut(self, runs: list[EventStream], rng: np.random.Generator) -> list[EventStream]:
        """Return slices of the runs, long enough that an image without warping is smeared."""
        for density in _DENSITIES:
            size = int(density * self._width * self._height)
            slices = []
            for run in runs:
                count = min(max(len(run) // size, 1), _NUM_SLICES // len(runs))
                length = len(run) if len(run) < 2 * size else size
                for begin in np.linspace(0, len(run) - length, count) if count > 1 else [(len(run) - length) / 2]:
                    events = run[int(begin) : int(begin) + length]
                    if len(events) > _MAX_EVENTS:
                        events = events[np.sort(rng.choice(len(events), _MAX_EVENTS, replace=False))]
                    slices.append(events)
            if contrast_of([self._warp(events, STILL) for events in slices]) < _SMEARED_CONTRAST:
                break
        return slices

    @property
    def spans(self) -> list[tuple[int, int]]:
        """Times of the first and the last event of each slice in nanoseconds."""
        return [(int(events.t[0]), int(events.t[-1])) for events in self._slices]

    def compare(self, hypothesis: Hypothesis, slices: slice = slice(None)) -> Comparison | None:
        """Compare the contrast under a hypothesis with the given contrast, over the same events.

        Returns:
            The comparison, or None if too few events have a pose and a direction under the hypothesis.
        """
        covered = TimeWindow(self._trajectory.start, self._trajectory.end)
        compared: dict[int, tuple[WarpedSlice, WarpedSlice]] = {}
        has_direction = np.isfinite(hypothesis.plane(self._plane) + self._plane).all(-1)
        for index in range(len(self._slices))[slices]:
            events = self._slices[index]
            visible = has_direction[events.y, events.x]
            usable = visible & covered.contains(events.t + hypothesis.clock_offset)
            if usable.sum() < max(_MIN_USABLE_SHARE * visible.sum(), 2):
                continue
            part = events[usable]
            as_given = self.given[index] if usable.all() else self._warp(part, GIVEN)
            compared[index] = as_given, self._warp(part, hypothesis)
        if not compared:
            return None
        in_favor = {index for index, pair in compared.items() if _compare(hypothesis, [pair]).is_clearly_better}
        return replace(_compare(hypothesis, compared.values()), slices_in_favor=frozenset(in_favor))

    def compare_alternatives(self) -> list[Comparison]:
        """Compare all alternatives whose events the poses cover, and return the comparisons, the best first.

        An alternative that is much worse than what is given in a third of the slices is not tried on the others. The
        best clock offset is refined.
        """
        offsets = [round(sign * seconds * 1e9) for seconds in CLOCK_OFFSETS for sign in (-1, 1)]
        found = []
        for hypothesis in (*ALTERNATIVES, *map(clock_hypothesis, offsets)):
            comparison = self.compare(hypothesis, slice(None, None, 3))
            if comparison is not None and comparison.contrast > _HOPELESS_SHARE * comparison.given:
                comparison = self.compare(hypothesis)
            if comparison is not None:
                found.append(comparison)
        clocks = [c for c in found if c.hypothesis.clock_offset and c.is_clearly_better]
        if clocks:
            best = max(clocks, key=lambda c: c.contrast - c.given).hypothesis.clock_offset
            between = [self.compare(clock_hypothesis(round(best * factor))) for factor in REFINEMENTS]
            found += [comparison for comparison in between if comparison is not None]
        return sorted(found, key=lambda c: c.contrast - c.given, reverse=True)

    def shuffled_contrasts(self) -> NDArray[np.float64]:
        """Return the contrasts of the same events under the given poses, after their order was lost.

        Within each slice the polarities, the pixels, or both are permuted, which is to permute the times. Noise has the
        contrast that is left.
        """
        rng = np.random.default_rng(0)
        contrasts = []
        for columns in _SHUFFLED_COLUMNS * _NUM_SHUFFLES:
            permuted = []
            for events in self._slices:
                order = rng.permutation(len(events))
                permuted.append(replace(events, **{name: getattr(events, name)[order] for name in columns}))
            contrasts.append(contrast_of([self._warp(events, GIVEN) for events in permuted]))
        return np.array(contrasts)

    def _geometry(
        self, events: EventStream, hypothesis: Hypothesis
    ) -> tuple[NDArray[np.float32], float, NDArray[np.float64], NDArray[np.float64]]:
        """Return where the reference view, which has the pose in the middle of a slice, sees the events of the slice.

        Returns:
            Lines for :func:`accumulate`, the largest distance of a pose from the reference, the reference (4, 4), and
            fx fy cx cy of the images.
        """
        camera, num_poses, focal_factor = self._camera, _NUM_POSES, hypothesis.focal_factor
        # Times since 1970 would be rounded by 128 ns as decimals, and may then lie outside the poses.
        times = events.t[0] + np.linspace(0, events.t[-1] - events.t[0], num_poses).astype(np.int64)
        if hypothesis.poses not in self._meant:
            self._meant[hypothesis.poses] = self._trajectory.transform(hypothesis.poses)
        poses = homogeneous(self._meant[hypothesis.poses].interpolate(times + hypothesis.clock_offset))
        reference = poses[num_poses // 2]
        relative = (torch.linalg.inv(reference) @ poses)[:, :3].numpy()
        duration = max(int(events.t[-1] - events.t[0]), 1)
        indices = np.rint((events.t - events.t[0]) / duration * (num_poses - 1)).astype(np.int64)
        points = (hypothesis.plane(self._plane)[events.y, events.x] + self._jitter[: len(events)]) / focal_factor
        focal = camera.fx * focal_factor, camera.fy * focal_factor
        fx, fy, cx, cy = intrinsics = np.array([*focal, camera.cx, camera.cy]) / self._binning
        right, down, forward, (p, q, w) = np.take(relative.T, indices, -1)
        x, y, z = right * points[:, 0] + down * points[:, 1] + forward
        # The reference view does not see what is behind it.
        x, y = [x, y] / np.where(z > 1e-3, z, np.nan)
        # The ray (x, y, 1) from the camera's position (p, q, w) at the event meets the plane at depth - w along it.
        lines = np.stack([fx * x + cx, fx * (p - w * x), fy * y + cy, fy * (q - w * y), w]).astype(np.float32)
        baseline = float(np.linalg.norm(relative[:, :, 3], axis=1).max())
        return lines, baseline, reference.numpy(), intrinsics

    def _warp(self, events: EventStream, hypothesis: Hypothesis) -> WarpedSlice:
        """Warp a slice at every depth, and keep the depth of most contrast in each tile."""
        lines, baseline, reference, (fx, fy, cx, cy) = self._geometry(events, hypothesis)
        inverse_depths = np.zeros(1)
        if baseline > 0:
            steps = np.arange(0, self._width / _DEPTH_STEP + 1)
            inverse_depths = steps * _DEPTH_STEP / (fx * baseline)
        warps = ((lines, inverse_depth) for inverse_depth in inverse_depths)
        best, energy, brightness = sharpest(warps, events.p.astype(np.float32), self._height, self._width)
        rows, columns = (np.arange(n) * TILE + TILE / 2 for n in best.shape)
        x, y = np.meshgrid((columns - cx) / fx, (rows - cy) / fy)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = 1 / inverse_depths[best]
            in_camera = np.stack([x, y, np.ones_like(x)], -1) * depth[..., None]
            points = in_camera @ reference[:3, :3].T + reference[:3, 3]
        return WarpedSlice(energy, brightness, depth, points)

    def picture(self) -> NDArray[np.uint8]:
        """Draw the slice with the most contrast as it came and, to the right of it, warped to one view.

        Returns:
            (height, width, 3) display values. Small sensors are enlarged by a whole factor, to at most 480 rows.
        """
        best = max(range(len(self.given)), key=lambda index: contrast_of([self.given[index]]))
        events, depth = self._slices[best], self.given[best].depth
        polarity = events.p.astype(np.float32)
        unwarped, warped, net, total = np.zeros((4, self._height, self._width), np.float32)
        accumulate(self._geometry(events, STILL)[0], polarity, np.float32(0), unwarped, total)
        lines, depth_of_pixel = self._geometry(events, GIVEN)[0], np.kron(depth, np.ones((TILE, TILE)))
        for value in np.unique(depth):
            accumulate(lines, polarity, np.float32(1 / value), net, total)
            warped[depth_of_pixel == value] = net[depth_of_pixel == value]
        # The tiles reach beyond the sensor.
        width, height = -(-self._camera.width // self._binning), -(-self._camera.height // self._binning)
        both = np.rint(np.concatenate([unwarped[:height, :width], warped[:height, :width]], 1)).astype(np.int64)
        picture = net_picture(both)
        factor = max(_PICTURE_HEIGHT // height, 1)
        return picture.repeat(factor, 0).repeat(factor, 1)


def contrast_of(slices: Sequence[WarpedSlice]) -> float:
    """Return the contrast of all tiles of the slices together."""
    return float(sum(s.energy.sum() for s in slices) / max(sum(s.brightness.sum() for s in slices), 1e-30))


def _compare(hypothesis: Hypothesis, pairs: Iterable[tuple[WarpedSlice, WarpedSlice]]) -> Comparison:
    given, alternative = zip(*pairs, strict=True)
    residuals = zip(_residuals(given), _residuals(alternative), strict=True)
    # The standard error of the difference of two ratios of sums, over the tiles.
    error = np.sqrt(sum(np.square(other - one).sum() for one, other in residuals))
    difference = (contrast_of(alternative) - contrast_of(given)) / max(float(error), 1e-12)
    return Comparison(hypothesis, contrast_of(alternative), contrast_of(given), difference)


def _residuals(slices: Sequence[WarpedSlice]) -> list[NDArray[np.float64]]:
    """Return by how much each (R, C) tile of each slice raises the contrast of all slices, to first order."""
    contrast, brightness = contrast_of(slices), max(sum(s.brightness.sum() for s in slices), 1e-30)
    return [(one.energy - contrast * one.brightness) / brightness for one in slices]
