"""Given poses, corrected by feature tracks in images of the events, as far as the tracks are to be trusted more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve
from scipy.spatial.transform import Rotation

from aenerf_ns.pose_estimation.bundle_adjustment import Array, TrackAdjustment, Tracks, move_poses

# Errors of neighboring tracks are alike, and those of all tracks of an image partly so: the variance that groups of
# tracks show is too small by this factor. From exact poses of three scenes, chosen so that poses stay.
_COHERENCE = 4.0
# Square pixels: the smallest variance of a track's error that is believed.
_MIN_VARIANCE = 0.5
# The errors of the given poses are a sum of smooth processes of this number of correlation times.
_NUM_TIMES = 6
# Degrees: where the search for the size of the processes begins.
_FIRST_SIZE = 0.3
# Degrees, of a late clock. Around an object at constant speed, that is a world that is turned: tracks say nothing of
# it, and it keeps this size.
_FIRST_CLOCK_SIZE = 0.03
# Which variance each of the shared components has, six of the mount and one of the clock.
_SHARED_VARIANCES = [-2] * 6 + [-1]
# Seconds, and degrees: smaller errors of the clock and of the mount are not named.
_VISIBLE_OFFSET, _VISIBLE_DEGREES = 1e-3, 0.1
# Degrees. A process of size zero could not grow again.
_SIZE_LIMITS = (0.003, 10.0)
_VARIANCE_UPDATES = 6
# Share of an orientation's variance that tracks take away at least, if they say anything of it.
_WEAK = 0.3
_NUM_DRAWS = 8
_STEPS_PER_ROUND = 3


@dataclass(frozen=True)
class SharedError:
    """The error that all given poses share: that of the clock, and that of the camera's mount.

    Attributes:
        clock_offset: seconds by which the clock of the poses is ahead of that of the events.
        mount: (6,) twist from the given camera to the true one, in the given camera's frame.
        share: of the variance of the corrections that it makes.
    """

    clock_offset: float
    mount: Array
    share: float

    def report(self) -> dict[str, float]:
        """Return the figures as plain values for JSON."""
        return {
            "clock_offset_seconds": self.clock_offset,
            "mount_degrees": float(np.rad2deg(np.linalg.norm(self.mount[3:]))),
            "mount_translation": float(np.linalg.norm(self.mount[:3])),
            "share": self.share,
        }

    def summary(self) -> str:
        """Return it in words."""
        found, parts = self.report(), []
        if abs(self.clock_offset) > _VISIBLE_OFFSET:
            side = "ahead of" if self.clock_offset > 0 else "behind"
            parts.append(f"their clock were {abs(self.clock_offset) * 1e3:.1f} ms {side} that of the events")
        if found["mount_degrees"] > _VISIBLE_DEGREES or not parts:
            turned, moved = found["mount_degrees"], found["mount_translation"]
            parts.append(f"the camera were turned by {turned:.2f} degrees and moved by {moved:.2g} in its mount")
        return f"{self.share:.0%} of it is as if {' and '.join(parts)}"


class PoseRefinement:
    """Find the twists of poses that explain the tracks, with a prior whose size is estimated from the same tracks.

    The errors of the given poses are Gaussian processes with the correlations exp(−(Δt / τ)² / 2) of several times τ,
    and those of a wrong mount of the camera and of a clock that is off. The variances maximize the evidence (variance
    components, by MacKay's updates). A translation is as probable as the rotation that moves the picture as much,
    because tracks can hardly tell them apart. What the tracks say is weighed by how much groups of neighboring tracks
    disagree. So where the tracks know less than the given poses, the poses stay as given.

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
        # (6 N, 7) twists that the clock and the mount make, of about a radian each.
        shared = _shared_moves(seconds, given)
        sizes = np.sqrt(np.square(shared / self._units[:, None]).sum(1).mean(0))
        # A camera that does not move has no clock.
        self._shared_units = 1 / np.maximum(sizes, 1e-6)
        self._shared = (shared * self._shared_units).reshape(-1, 7)
        self._shared_found = np.zeros(7)
        self._variances = np.square(np.deg2rad([*[_FIRST_SIZE] * (_NUM_TIMES + 1), _FIRST_CLOCK_SIZE]))
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
            twists = self._solve(*adjustment.linearize(self.poses))
            adjustment.move_points((twists - self.twists).ravel())
            self.twists = twists
            adjustment.adjust_points(self.poses, 2)

    def shared_error(self) -> SharedError:
        """Return what the mount and the clock have of the twists."""
        *mount, clock_offset = self._shared_units * self._shared_found
        others = self.twists - (self._shared @ self._shared_found).reshape(self.twists.shape)
        left, total = (np.square(twists / self._units).sum() for twists in (others, self.twists))
        return SharedError(float(clock_offset), np.array(mount), max(float(1 - left / max(total, 1e-30)), 0.0))

    def is_weak(self) -> NDArray[np.bool_]:
        """Return for each of the N images whether the tracks leave its orientation about as uncertain as it was.

        They do so where there are few of them, and everywhere if the given poses are good.
        """
        prior = self._times_prior(np.eye(self.twists.size))
        gained = prior @ lu_solve(self._factors(), self._weight @ prior)
        variances, gains = (matrix.diagonal().reshape(-1, 6)[:, 3:].sum(1) for matrix in (prior, gained))
        return gains < _WEAK * variances

    def _solve(self, hessian: Array, group_gradients: Array) -> Array:
        """Update the variances of the prior, and return the (N, 6) most probable twists."""
        noise = self._noise(hessian, group_gradients)
        self._weight = hessian / noise
        pull = self._weight @ self.twists.ravel() - group_gradients.sum(0) / noise
        # The trace of a process's covariance times another matrix is a mean over random draws from the process.
        normal = np.random.default_rng(self._seed).normal(size=(_NUM_TIMES, len(self.twists), 6 * _NUM_DRAWS))
        draws = (self._roots @ normal).reshape(*normal.shape[:2], 6, _NUM_DRAWS) * self._units[:, None]
        draws = draws.transpose(1, 2, 0, 3).reshape(self.twists.size, -1)
        weighted_draws, weighted_shared = self._weight @ draws, self._weight @ self._shared
        for _ in range(_VARIANCE_UPDATES):
            factors = self._factors()
            force = lu_solve(factors, pull).reshape(self.twists.shape)
            expected = (draws * lu_solve(factors, weighted_draws)).sum(0).reshape(_NUM_TIMES, -1).mean(1)
            found = np.square(self._roots.transpose(0, 2, 1) @ (force * self._units)).sum((1, 2))
            expected_shared = (self._shared * lu_solve(factors, weighted_shared)).sum(0)
            found_shared = np.square(self._shared.T @ force.ravel())
            expected = np.append(expected, [expected_shared[:6].sum(), expected_shared[6]])
            found = np.append(found, [found_shared[:6].sum(), found_shared[6]])
            # The ones keep the size of a process if the tracks say nothing of it.
            growth = (self._variances * found + 1) / (self._variances * expected + 1)
            self._variances = np.clip(self._variances * np.clip(growth, 0.1, 10), *np.square(np.deg2rad(_SIZE_LIMITS)))
        force = lu_solve(self._factors(), pull)
        self._shared_found = self._variances[_SHARED_VARIANCES] * (self._shared.T @ force)
        return self._times_prior(force[:, None]).reshape(self.twists.shape)

    def _factors(self) -> tuple[Array, Array]:
        """Factorize identity plus the tracks' weight times the prior's covariance."""
        return lu_factor(np.eye(len(self._weight)) + self._times_prior(self._weight.T).T)

    def _times_prior(self, values: Array) -> Array:
        """Multiply the (6 N, 6 N) covariance of the prior with values (6 N, K)."""
        scaled = np.square(self._units)[:, None] * values.reshape(*self.twists.shape, -1)
        shared = self._variances[_SHARED_VARIANCES, None] * (self._shared.T @ values)
        return np.tensordot(self._covariance(), scaled, 1).reshape(values.shape) + self._shared @ shared

    def _covariance(self) -> Array:
        """Return the (N, N) covariance of each component of the errors that change in time, in square radians."""
        return np.tensordot(self._variances[:_NUM_TIMES], self._correlations, 1)

    def _noise(self, hessian: Array, group_gradients: Array) -> float:
        """Return the variance of a track's error in square pixels, from how groups of tracks pull at the poses."""
        covariance = self._covariance()
        pulls = group_gradients.reshape(-1, *self.twists.shape) * self._units
        blocks = np.einsum("ncmc,c->nm", hessian.reshape(*self.twists.shape * 2), np.square(self._units))
        pulled = np.einsum("gnc,nm,gmc->", pulls, covariance, pulls, optimize=True)
        return _COHERENCE * max(_MIN_VARIANCE, float(pulled / max(np.sum(covariance * blocks), 1e-30)))


def _shared_moves(seconds: Array, given: Array) -> Array:
    """Return the (N, 6, 7) twists of poses by each component of their mount, and by a second of their clock."""
    rotations = given[:-1, :, :3].transpose(0, 2, 1)
    turns = Rotation.from_matrix(rotations @ given[1:, :, :3]).as_rotvec()
    chords = (rotations @ np.diff(given[:, :, 3:], axis=0))[..., 0]
    # The camera turns on the way: seen from its middle, a chord points along the arc.
    steps = np.concatenate([Rotation.from_rotvec(-turns / 2).apply(chords), turns], 1)
    path = np.concatenate([np.zeros((1, 6)), steps.cumsum(0)])
    velocities = np.gradient(path, seconds, axis=0, edge_order=2)
    return np.concatenate([np.tile(np.eye(6), (len(given), 1, 1)), velocities[..., None]], -1)
