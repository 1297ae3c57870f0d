"""Camera paths, and the two speeds at which a camera travels them.

A path maps a parameter s in [0, 1] to a camera-to-world matrix (4, 4) with OpenCV axes (x right, y down, z forward).
The world's z axis points up. Lengths are in meters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from scipy.special import i0, iv

from aenerf_ns.errors import DataError
from aenerf_ns.simulator.arrays import Array

HARD_SPEED_RATIO = 8.0
HARD_MEAN_SPEED = float(i0(np.log(HARD_SPEED_RATIO)))
"""Mean of 8 ** sin(2 pi t) over a period: 2.411."""
ORIGIN = (0.0, 0.0, 0.0)
_MAX_TRIES = 200
_MAX_CLEARANCE = 0.15
_NUM_STEPS = 2000


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0), roll: float = 0.0) -> Array:
    """Return the camera-to-world matrix (4, 4) of a camera that looks from ``eye`` at ``target``.

    It is turned by ``roll`` radians about its optical axis. ``up`` must not lie along the gaze.
    """
    forward = np.asarray(target, np.float64) - np.asarray(eye, np.float64)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, np.float64))
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    pose[:3, 1] = np.cos(roll) * down - np.sin(roll) * right
    pose[:3, 2], pose[:3, 3] = forward, eye
    return pose


class Obstacles(Protocol):
    """The surfaces that cameras must keep away from."""

    def distance(self, points: ArrayLike, /) -> NDArray[np.floating]:
        """Return the distance (N,) of points (N, 3) from the nearest surface."""

    def blocked(self, rays: NDArray[np.float32], /) -> NDArray[np.bool_]:
        """Tell for each ray (N, 6) whether a surface lies between its origin and origin + direction."""


class FreeSpace:
    """The space at a clearance from every face: 0.15 m, or less along a path of less than about a meter.

    Args:
        obstacles: the mesh, or None where all space is free.
        path_size: about the distance of the path from its middle, in meters.
    """

    def __init__(self, obstacles: Obstacles | None, path_size: float) -> None:
        self._obstacles = obstacles
        self._clearance = min(_MAX_CLEARANCE, 0.13 * path_size)

    def is_free(self, eye: ArrayLike) -> bool:
        """Tell whether a position (3,) keeps the clearance."""
        return self._obstacles is None or bool(self._obstacles.distance(eye)[0] >= self._clearance)

    def is_reached(self, eye: ArrayLike, home: ArrayLike) -> bool:
        """Tell whether a position (3,) keeps the clearance and sees ``home``: both are on one side of all walls."""
        segment = np.concatenate([np.asarray(home), np.subtract(eye, home)]).astype(np.float32)
        return self.is_free(eye) and (self._obstacles is None or not self._obstacles.blocked(segment[None])[0])

    def require_clear(self, path: CameraPath) -> None:
        """Raise a ValueError if a path passes through a face or comes too close to one."""
        if self._obstacles is None:
            return
        eyes = np.stack([path(s)[:3, 3] for s in np.linspace(0, 1, _NUM_STEPS + 1)]).astype(np.float32)
        distance = self._obstacles.distance(eyes)
        through = self._obstacles.blocked(np.concatenate([eyes[:-1], np.diff(eyes, axis=0)], axis=1))
        if through.any():
            raise ValueError(f"the camera's path runs into the mesh at {eyes[through.argmax()].round(2)}")
        if distance.min() < self._clearance:
            raise ValueError(
                f"the camera's path comes within {distance.min():.3f} m of the mesh at "
                f"{eyes[distance.argmin()].round(2)}; it must keep {self._clearance:.3g} m"
            )


class CameraPath(ABC):
    """A camera's path through a scene, and held-out views around it."""

    @abstractmethod
    def __call__(self, s: float) -> Array:
        """Return the pose (4, 4) at a parameter in [0, 1]."""

    @abstractmethod
    def _validation_view(self, k: int, count: int) -> Array:
        """Return the k-th of the validation views."""

    @abstractmethod
    def _test_view(self, rng: np.random.Generator) -> Array:
        """Draw a test view."""

    def validation_views(self, count: int) -> Array:
        """Return views (count, 4, 4) spread evenly around the path, clear of the mesh.

        Raises:
            DataError: no position is clear of the mesh.
        """
        return np.array([self._validation_view(k, count) for k in range(count)]).reshape(-1, 4, 4)

    def test_views(self, count: int, seed: int) -> Array:
        """Return random views (count, 4, 4) around the path, clear of the mesh.

        Raises:
            DataError: no position is clear of the mesh.
        """
        rng = np.random.default_rng(seed)
        return np.array([self._test_view(rng) for _ in range(count)]).reshape(-1, 4, 4)


class RoomPath(CameraPath):
    """A closed loop around the middle of the room. The camera looks across the room, high and low, slightly rolled."""

    def __call__(self, s: float) -> Array:
        return self._pose(2 * np.pi * s, 0.0, 0.0, 0.0)

    def _validation_view(self, k: int, count: int) -> Array:
        # The views lie by turns inside, outside, above and below the path.
        return self._pose(2 * np.pi * (k + 0.5) / count, 0.12 * np.cos(2.4 * k), 0.12 * np.sin(2.4 * k), 0.0)

    def _test_view(self, rng: np.random.Generator) -> Array:
        return self._pose(*rng.uniform([0, -0.15, -0.15, -0.5], [2 * np.pi, 0.15, 0.15, 0.5]))

    @staticmethod
    def _pose(angle: float, outwards: float, upwards: float, gaze: float) -> Array:
        """Return the pose at an angle of the loop, displaced in meters, its gaze turned by ``gaze`` radians."""
        radius = 1.15 + 0.10 * np.sin(2 * angle) + outwards
        height = 1.40 + 0.15 * np.sin(3 * angle + 0.7) + upwards
        opposite = angle + np.pi + 0.35 * np.sin(2 * angle + 0.4) + gaze
        target = (np.cos(opposite), np.sin(opposite), 0.95 + 0.5 * np.sin(3 * angle - 0.6) - 0.3 * gaze)
        eye = (radius * np.cos(angle), radius * np.sin(angle), height)
        return look_at(eye, target, roll=0.08 * np.sin(2 * angle + 1.0))


class ObjectPath(CameraPath):
    """A spiral from the equator to the pole of a hemisphere, as in Robust e-NeRF's scenes.

    Args:
        turns: of the spiral.
        radius, center: of the hemisphere, in meters.
        obstacles: the mesh that cameras must not come near to; None if there is no such mesh.

    Raises:
        ValueError: the path comes too near to the mesh.
    """

    def __init__(
        self, turns: float = 4.0, radius: float = 4.0, center: ArrayLike = ORIGIN, obstacles: Obstacles | None = None
    ) -> None:
        self._turns, self._radius, self._center = turns, radius, np.asarray(center, np.float64)
        self._space = FreeSpace(obstacles, radius)
        self._space.require_clear(self)

    def __call__(self, s: float) -> Array:
        return self._pose(2 * np.pi * self._turns * s, 0.5 * np.pi * s, self._radius, ORIGIN)

    def _validation_view(self, k: int, count: int) -> Array:
        # The views lie on a golden-angle spiral. A view turns about the vertical until it is clear of the mesh.
        elevation = np.arcsin((k + 0.5) / count)
        return self._first_free(lambda i: self._pose(2.399963 * k + 0.1 * i, elevation, self._radius, ORIGIN))

    def _test_view(self, rng: np.random.Generator) -> Array:
        def candidate(_: int) -> Array:
            azimuth, elevation = rng.uniform(0, 2 * np.pi), np.arcsin(rng.uniform(0, 1))
            distance, target = rng.uniform(3.6, 4.4), rng.uniform(-0.15, 0.15, 3)
            return self._pose(azimuth, elevation, self._radius / 4.0 * distance, self._radius / 4.0 * target)

        return self._first_free(candidate)

    def _first_free(self, candidate: Callable[[int], Array]) -> Array:
        for pose in map(candidate, range(_MAX_TRIES)):
            if self._space.is_free(pose[:3, 3]):
                return pose
        raise DataError("views around the scene", "no position is clear of the mesh", "give its path a larger radius")

    def _pose(self, azimuth: float, elevation: float, radius: float, target: ArrayLike) -> Array:
        """Return a pose on a hemisphere that looks at ``target``, which is relative to the center."""
        outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        eye = radius * (np.cos(elevation) * outward + np.sin(elevation) * np.array([0.0, 0.0, 1.0]))
        # The direction of growing elevation is a vertical that stays defined at the pole.
        up = np.cos(elevation) * np.array([0.0, 0.0, 1.0]) - np.sin(elevation) * outward
        return look_at(eye + self._center, np.add(target, self._center), up)


class InnerPath(CameraPath):
    """A path through a place. Held-out views lie beside it.

    A held-out view moves towards the path until its camera is clear of the mesh and on the same side of all walls,
    or to the path itself.
    """

    _max_turn = 0.5
    """Radians that the gaze of a test view is turned by at most."""

    def _surround(self, eyes: Array, obstacles: Obstacles | None) -> None:
        """Learn how far views may lie from the path, from positions (N, 3) on it."""
        # Root mean square distance of the positions from their mean.
        size = float(np.sqrt(((eyes - eyes.mean(axis=0)) ** 2).sum(axis=1).mean()))
        # The proportion is the built-in room's.
        self._spread = min(0.13 * size, 0.5)
        self._space = FreeSpace(obstacles, size)

    @abstractmethod
    def _pose(self, s: float, shift: Array, gaze: float) -> Array:
        """Return the pose displaced by ``shift`` meters (right, up, forward), turned by ``gaze`` radians."""

    def __call__(self, s: float) -> Array:
        return self._pose(s, np.zeros(3), 0.0)

    def _validation_view(self, k: int, count: int) -> Array:
        shift = np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.0]) * (0.8 * self._spread)
        return self._free_pose((k + 0.5) / count, shift, 0.0)

    def _test_view(self, rng: np.random.Generator) -> Array:
        s, shift = rng.uniform(), rng.uniform(-self._spread, self._spread, 3)
        return self._free_pose(s, shift, rng.uniform(-self._max_turn, self._max_turn))

    def _free_pose(self, s: float, shift: Array, gaze: float) -> Array:
        home = self(s)[:3, 3]
        for part in np.linspace(1, 0, 11):
            pose = self._pose(s, part * shift, gaze)
            if self._space.is_reached(pose[:3, 3], home):
                break
        return pose  # at last on the path itself


class WalkPath(InnerPath):
    """A closed smooth walk through given positions, looking at given targets.

    Positions and targets are periodic cubic splines. Their parameter is the distance between neighboring positions, so
    that the speed hardly varies.

    Args:
        positions: (N, 3) that the camera passes, N at least 4. The camera returns to the first.
        targets: (N, 3) that the camera looks at from the positions.
        obstacles: see `ObjectPath`.

    Raises:
        ValueError: there are too few points, neighbors in one position, or a gaze that is vertical or has no direction,
            or the path comes too near to the mesh.
    """

    def __init__(self, positions: ArrayLike, targets: ArrayLike, obstacles: Obstacles | None = None) -> None:
        eyes, looked_at = np.asarray(positions, np.float64), np.asarray(targets, np.float64)
        if eyes.ndim != 2 or eyes.shape[1] != 3 or len(eyes) < 4 or eyes.shape != looked_at.shape:
            raise ValueError(f"positions {eyes.shape} and targets {looked_at.shape} must both be (N, 3), N at least 4")
        closed = np.concatenate([eyes, eyes[:1]])
        lengths = np.linalg.norm(np.diff(closed, axis=0), axis=1)
        if (lengths <= 1e-6 * lengths.max()).any():
            raise ValueError(f"positions {int(lengths.argmin())} and the next are the same")
        knots = np.append(0, np.cumsum(lengths)) / lengths.sum()
        self._eye = CubicSpline(knots, closed, bc_type="periodic")
        self._target = CubicSpline(knots, np.concatenate([looked_at, looked_at[:1]]), bc_type="periodic")
        fine = np.linspace(0, 1, 2001)
        gaze = self._target(fine) - self._eye(fine)
        if (np.linalg.norm(gaze[:, :2], axis=1) < 0.02 * np.linalg.norm(gaze, axis=1) + 1e-9).any():
            raise ValueError("the camera looks straight up or down, or at its own position; move the targets")
        self._surround(eyes, obstacles)
        self._space.require_clear(self)

    def _pose(self, s: float, shift: Array, gaze: float) -> Array:
        """Return the pose displaced by ``shift`` meters (right, up, level forward), turned by ``gaze`` radians."""
        eye, target = self._eye(s % 1.0), self._target(s % 1.0)
        forward = (target - eye) * [1.0, 1.0, 0.0]
        forward /= np.linalg.norm(forward)
        right = np.array([forward[1], -forward[0], 0.0])
        across, up, along = shift
        eye = eye + across * right + along * forward + [0.0, 0.0, up]
        cos, sin = np.cos(gaze), np.sin(gaze)
        x, y, z = target - eye
        return look_at(eye, eye + np.array([cos * x - sin * y, sin * x + cos * y, z]))


class TrackPath(InnerPath):
    """The path of a camera whose poses are known at equal intervals. Splines run through the poses.

    Args:
        poses: (N, 4, 4) camera-to-world, OpenCV axes, N at least 2.
        max_turn: radians that the gaze of a test view is turned by at most.
        obstacles: see `ObjectPath`.
    """

    def __init__(self, poses: ArrayLike, max_turn: float, obstacles: Obstacles | None = None) -> None:
        given = np.asarray(poses, np.float64)
        knots = np.linspace(0, 1, len(given))
        self._eye = CubicSpline(knots, given[:, :3, 3])
        self._rotation = RotationSpline(knots, Rotation.from_matrix(given[:, :3, :3]))
        self._max_turn = max_turn
        self._surround(given[:, :3, 3], obstacles)

    def _pose(self, s: float, shift: Array, gaze: float) -> Array:
        pose, axes = np.eye(4), self._rotation(s).as_matrix()
        pose[:3, :3] = Rotation.from_rotvec([0, 0, gaze]).as_matrix() @ axes
        pose[:3, 3] = self._eye(s) + axes @ (shift * [1.0, -1.0, 1.0])
        return pose


@dataclass(frozen=True)
class SpeedProfile:
    """The times at which a camera passes the points of its path.

    The speed of `easy` is constant. The speed of `hard` is the easy speed times 8 ** sin(2 pi t), t in seconds: between
    an eighth and eight times as fast. These are the AE-NeRF paper's two settings.

    ``easy_duration`` is the seconds that the whole path takes at the easy speed, for both profiles.
    """

    name: Literal["easy", "hard"]
    easy_duration: float

    @property
    def duration(self) -> float:
        """Duration of the whole path in seconds."""
        return float(self.time(1.0))

    def parameter(self, time: ArrayLike) -> Array:
        """Return the path parameters at times in seconds, any shape."""
        time = np.asarray(time, np.float64)
        return (time if self.name == "easy" else _hard_advance(time)) / self.easy_duration

    def time(self, parameter: ArrayLike) -> Array:
        """Return the times in seconds at which the camera passes path parameters, any shape. Inverts `parameter`."""
        advance = np.asarray(parameter, np.float64) * self.easy_duration
        if self.name == "easy":
            return advance
        # The speed repeats every second. Newton's method starts from an interpolation.
        whole, grid = np.floor(advance / HARD_MEAN_SPEED), np.linspace(0, 1, 1001)
        time = whole + np.interp(advance - HARD_MEAN_SPEED * whole, _hard_advance(grid), grid)
        for _ in range(4):
            time = time - (_hard_advance(time) - advance) / HARD_SPEED_RATIO ** np.sin(2 * np.pi * time)
        return time


def _hard_advance(time: Array) -> Array:
    """Integrate 8 ** sin(2 pi t) from 0, by the Jacobi-Anger expansion.

    exp(a sin x) = I0(a) + 2 sum_n I_n(a) cos(n (x - pi / 2)).
    """
    order = np.arange(1, 25)
    weight = 2 * iv(order, np.log(HARD_SPEED_RATIO)) / order
    phase = 2 * np.pi * np.asarray(time)[..., None]
    waves = np.sin(order * (phase - np.pi / 2)) + np.sin(order * np.pi / 2)
    return HARD_MEAN_SPEED * np.asarray(time) + (weight * waves).sum(axis=-1) / (2 * np.pi)
