"""Given poses, corrected by feature tracks in images of the events, as far as the tracks are to be trusted more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve

from aenerf_ns.pose_estimation.bundle_adjustment import Array, PoseInformation, TrackAdjustment, Tracks, move_poses

# Errors of neighboring tracks are alike, and those of all tracks of an image partly so: the variance that groups of
# tracks show is too small by this factor. From exact poses of three scenes, chosen so that poses stay.
_COHERENCE = 4.0
# Square pixels: the smallest variance of a track's error that is believed.
_MIN_VARIANCE = 0.5
# The errors of the given poses are a sum of smooth processes of this number of correlation times.
_NUM_TIMES = 6
# Degrees: where the search for the size of the processes begins.
_FIRST_SIZE = 0.3
_MAX_SIZE = 10.0
_VARIANCE_UPDATES = 6
# Share of an orientation's variance that tracks take away at least, if they say anything of it.
_WEAK = 0.3
_NUM_DRAWS = 8
_STEPS_PER_ROUND = 3
# Translation and rotation parts of a twist.
_PARTS = (slice(0, 3), slice(3, 6))


@dataclass(frozen=True)
class Process:
    """A part of the given poses' errors: a Gaussian process of the twists' translations or rotations.

    Attributes:
        part: the three components of the twists.
        correlation: (N, N) between the images: exp(−(Δt / correlation time)² / 2).
        root: (N, N) lower triangular root of the correlation.
    """

    part: slice
    correlation: Array
    root: Array


class PoseRefinement:
    """Find the twists of poses that explain the tracks, with a prior whose size is estimated from the same tracks.

    The errors of the given poses are Gaussian processes of several correlation times, whose variances maximize the
    evidence (variance components, by MacKay's updates). What the tracks say is weighed by how much groups of
    neighboring tracks disagree. So where the tracks know less than the given poses, the poses stay as given.

    Args:
        seconds: (N,) times of the images, increasing.
        given: (N, 3, 4) camera-to-world.
        depth: the scene's distance from the cameras in the units of the poses.
        seed: of random draws.
    """

    def __init__(self, seconds: Array, given: Array, depth: float, seed: int) -> None:
        self._given, self._seed = given, seed
        self.twists = np.zeros((len(given), 6))
        gaps = np.abs(seconds[:, None] - seconds)
        # Errors that differ from image to image are of the shortest time.
        times = np.geomspace(0.5 * float(np.median(np.diff(seconds))), seconds[-1] - seconds[0], _NUM_TIMES)
        self._processes = []
        for time in times:
            correlation = np.exp(-0.5 * np.square(gaps / time))
            root = np.linalg.cholesky(correlation + 1e-6 * np.eye(len(gaps)))
            self._processes += [Process(part, correlation, root) for part in _PARTS]
        units = np.array([depth, 1.0] * _NUM_TIMES)
        self._variances = np.square(np.deg2rad(_FIRST_SIZE) * units)
        self._limits = np.square(np.deg2rad(_MAX_SIZE) * units)
        self._weight = np.zeros((self.twists.size,) * 2)

    @property
    def poses(self) -> Array:
        """The (N, 3, 4) refined poses, camera-to-world."""
        return move_poses(self._given, self.twists)

    def follow(self, tracks: Tracks) -> None:
        """Move the poses to tracks that were triangulated from them."""
        adjustment = TrackAdjustment(tracks, self._seed)
        adjustment.adjust_points(self.poses, 3)
        for _ in range(_STEPS_PER_ROUND):
            twists = self._solve(adjustment.linearize(self.poses))
            adjustment.move_points((twists - self.twists).ravel())
            self.twists = twists
            adjustment.adjust_points(self.poses, 2)

    def is_weak(self) -> NDArray[np.bool_]:
        """Return for each of the N images whether the tracks leave its orientation about as uncertain as it was."""
        prior = self._times_prior(np.eye(self.twists.size))
        gained = prior @ lu_solve(self._factors(), self._weight @ prior)
        variances, gains = (matrix.diagonal().reshape(-1, 6)[:, _PARTS[1]].sum(1) for matrix in (prior, gained))
        return gains < _WEAK * variances

    def _solve(self, information: PoseInformation) -> Array:
        """Update the variances of the prior, and return the (N, 6) most probable twists."""
        noise = self._noise(information)
        self._weight = information.hessian / noise
        pull = self._weight @ self.twists.ravel() - information.gradient / noise
        # The trace of a process's covariance times another matrix is a mean over random draws from the process.
        generator = np.random.default_rng(self._seed)
        draws = np.zeros((*self.twists.shape, len(self._processes), _NUM_DRAWS))
        for index, process in enumerate(self._processes):
            normal = generator.normal(size=(len(draws), 3 * _NUM_DRAWS))
            draws[:, process.part, index] = (process.root @ normal).reshape(-1, 3, _NUM_DRAWS)
        draws = draws.reshape(self.twists.size, -1)
        weighted_draws = self._weight @ draws
        for _ in range(_VARIANCE_UPDATES):
            factors = self._factors()
            force = lu_solve(factors, pull).reshape(self.twists.shape)
            expected = (draws * lu_solve(factors, weighted_draws)).sum(0).reshape(-1, _NUM_DRAWS).mean(1)
            found = np.array([np.square(process.root.T @ force[:, process.part]).sum() for process in self._processes])
            self._variances = np.minimum(self._variances * np.clip(found / expected, 0.1, 10), self._limits)
        force = lu_solve(self._factors(), pull)
        return self._times_prior(force[:, None]).reshape(self.twists.shape)

    def _factors(self) -> tuple[Array, Array]:
        """Factorize identity plus the tracks' weight times the prior's covariance."""
        return lu_factor(np.eye(len(self._weight)) + self._times_prior(self._weight.T).T)

    def _times_prior(self, values: Array) -> Array:
        """Multiply the (6 N, 6 N) covariance of the prior with values (6 N, K)."""
        product = np.zeros((*self.twists.shape, values.shape[1]))
        for part in _PARTS:
            mine = [
                (v, process)
                for v, process in zip(self._variances, self._processes, strict=True)
                if process.part == part
            ]
            covariance = np.sum([variance * process.correlation for variance, process in mine], 0)
            product[:, part] = np.tensordot(covariance, values.reshape(product.shape)[:, part], 1)
        return product.reshape(values.shape)

    def _noise(self, information: PoseInformation) -> float:
        """Return the variance of a track's error in square pixels, from how groups of tracks pull at the poses."""
        groups = information.group_gradients.reshape(-1, *self.twists.shape)
        blocks = information.hessian.reshape(*self.twists.shape, *self.twists.shape)
        pulled = expected = 0.0
        for variance, process in zip(self._variances, self._processes, strict=True):
            for component in range(process.part.start, process.part.stop):
                pull = groups[:, :, component]
                pulled += variance * float(np.sum(pull @ process.correlation * pull))
                expected += variance * float(np.sum(process.correlation * blocks[:, component, :, component]))
        return _COHERENCE * max(pulled / expected, _MIN_VARIANCE)
