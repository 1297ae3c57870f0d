"""Given poses, corrected by feature tracks in images of the events, as far as the tracks are to be trusted more."""

from __future__ import annotations

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
# Degrees. A process of size zero could not grow again.
_SIZE_LIMITS = (0.003, 10.0)
_VARIANCE_UPDATES = 6
# Share of an orientation's variance that tracks take away at least, if they say anything of it.
_WEAK = 0.3
_NUM_DRAWS = 8
_STEPS_PER_ROUND = 3


class PoseRefinement:
    """Find the twists of poses that explain the tracks, with a prior whose size is estimated from the same tracks.

    The errors of the given poses are Gaussian processes with the correlations exp(−(Δt / τ)² / 2) of several times τ.
    Their variances maximize the evidence (variance components, by MacKay's updates). A translation is as probable as
    the rotation that moves the picture as much, because tracks can hardly tell them apart. What the tracks say is
    weighed by how much groups of neighboring tracks disagree. So where the tracks know less than the given poses, the
    poses stay as given.

    Args:
        seconds: (N,) times of the images, increasing.
        given: (N, 3, 4) camera-to-world.
        depth: the scene's distance from the cameras in the units of the poses.
        seed: of random draws.
    """

    def __init__(self, seconds: Array, given: Array, depth: float, seed: int) -> None:
        self._given, self._seed = given, seed
        self.twists = np.zeros((len(given), 6))
        # Of a twist's components, per radian.
        self._units = np.array([depth, depth, depth, 1.0, 1.0, 1.0])
        gaps = np.abs(seconds[:, None] - seconds)
        # Errors that differ from image to image are of the shortest time.
        times = np.geomspace(0.5 * float(np.median(np.diff(seconds))), seconds[-1] - seconds[0], _NUM_TIMES)
        self._correlations = np.exp(-0.5 * np.square(gaps / times[:, None, None]))
        self._roots = np.linalg.cholesky(self._correlations + 1e-6 * np.eye(len(gaps)))
        self._variances = np.full(_NUM_TIMES, np.square(np.deg2rad(_FIRST_SIZE)))
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
        """Return for each of the N images whether the tracks leave its orientation about as uncertain as it was.

        They do so where there are few of them, and everywhere if the given poses are good.
        """
        prior = self._times_prior(np.eye(self.twists.size))
        gained = prior @ lu_solve(self._factors(), self._weight @ prior)
        variances, gains = (matrix.diagonal().reshape(-1, 6)[:, 3:].sum(1) for matrix in (prior, gained))
        return gains < _WEAK * variances

    def _solve(self, information: PoseInformation) -> Array:
        """Update the variances of the prior, and return the (N, 6) most probable twists."""
        noise = self._noise(information)
        self._weight = information.hessian / noise
        pull = self._weight @ self.twists.ravel() - information.gradient / noise
        # The trace of a process's covariance times another matrix is a mean over random draws from the process.
        normal = np.random.default_rng(self._seed).normal(size=(_NUM_TIMES, len(self.twists), 6 * _NUM_DRAWS))
        draws = (self._roots @ normal).reshape(*normal.shape[:2], 6, _NUM_DRAWS) * self._units[:, None]
        draws = draws.transpose(1, 2, 0, 3).reshape(self.twists.size, -1)
        weighted_draws = self._weight @ draws
        for _ in range(_VARIANCE_UPDATES):
            factors = self._factors()
            force = lu_solve(factors, pull).reshape(self.twists.shape)
            expected = (draws * lu_solve(factors, weighted_draws)).sum(0).reshape(_NUM_TIMES, -1).mean(1)
            found = np.square(self._roots.transpose(0, 2, 1) @ (force * self._units)).sum((1, 2))
            # The ones keep the size of a process if the tracks say nothing of it.
            growth = (self._variances * found + 1) / (self._variances * expected + 1)
            self._variances = np.clip(self._variances * np.clip(growth, 0.1, 10), *np.square(np.deg2rad(_SIZE_LIMITS)))
        force = lu_solve(self._factors(), pull)
        return self._times_prior(force[:, None]).reshape(self.twists.shape)

    def _factors(self) -> tuple[Array, Array]:
        """Factorize identity plus the tracks' weight times the prior's covariance."""
        return lu_factor(np.eye(len(self._weight)) + self._times_prior(self._weight.T).T)

    def _times_prior(self, values: Array) -> Array:
        """Multiply the (6 N, 6 N) covariance of the prior with values (6 N, K)."""
        scaled = np.square(self._units)[:, None] * values.reshape(*self.twists.shape, -1)
        return np.tensordot(self._covariance(), scaled, 1).reshape(values.shape)

    def _covariance(self) -> Array:
        """Return the (N, N) covariance of each component of the given poses' errors, in square radians."""
        return np.tensordot(self._variances, self._correlations, 1)

    def _noise(self, information: PoseInformation) -> float:
        """Return the variance of a track's error in square pixels, from how groups of tracks pull at the poses."""
        covariance = self._covariance()
        pulls = information.group_gradients.reshape(-1, *self.twists.shape) * self._units
        blocks = np.einsum("ncmc,c->nm", information.hessian.reshape(*self.twists.shape * 2), np.square(self._units))
        pulled = np.einsum("gnc,nm,gmc->", pulls, covariance, pulls, optimize=True)
        return _COHERENCE * max(_MIN_VARIANCE, float(pulled / max(np.sum(covariance * blocks), 1e-30)))
