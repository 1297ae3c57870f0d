"""Camera paths, and the two speeds at which they are travelled.

A path maps a parameter s in [0, 1] to a camera-to-world matrix (4, 4) with OpenCV axes (x right, y down, z forward)
in a world whose z axis points up; lengths are metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import i0, iv

Array = NDArray[np.float64]

HARD_SPEED_RATIO = 8.0
HARD_MEAN_SPEED = float(i0(np.log(HARD_SPEED_RATIO)))
"""Mean of 8 ** sin(2 pi t) over a period: 2.411."""


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0), roll: float = 0.0) -> Array:
    """Camera-to-world (4, 4) of a camera at ``eye`` that looks at ``target``, turned by ``roll`` (radians) about its
    optical axis. ``up`` must not lie along the gaze."""
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


def room_path(s: float) -> Array:
    """A closed loop around the middle of the room that looks across it, high and low, with a slight roll."""
    return _room_pose(2 * np.pi * s, 0.0, 0.0, 0.0)


def room_validation_views(count: int) -> Array:
    """Views (count, 4, 4) spread evenly along the room's path, by turns inside, outside, above and below it."""
    return _stack(
        [
            _room_pose(2 * np.pi * (k + 0.5) / count, 0.12 * np.cos(2.4 * k), 0.12 * np.sin(2.4 * k), 0.0)
            for k in range(count)
        ]
    )


def room_test_views(count: int, seed: int) -> Array:
    """Random views (count, 4, 4) in the ring the room's path runs through, with gazes of their own."""
    rng = np.random.default_rng(seed)
    return _stack(
        [
            _room_pose(
                rng.uniform(0, 2 * np.pi), rng.uniform(-0.15, 0.15), rng.uniform(-0.15, 0.15), rng.uniform(-0.5, 0.5)
            )
            for _ in range(count)
        ]
    )


def _stack(poses: Sequence[Array]) -> Array:
    """Poses (n, 4, 4), also of none."""
    return np.array(poses).reshape(-1, 4, 4)


def _room_pose(angle: float, outwards: float, upwards: float, gaze: float) -> Array:
    """The room path's pose at an angle of its loop, displaced in metres, its gaze turned by ``gaze`` radians."""
    radius = 1.15 + 0.10 * np.sin(2 * angle) + outwards
    height = 1.40 + 0.15 * np.sin(3 * angle + 0.7) + upwards
    opposite = angle + np.pi + 0.35 * np.sin(2 * angle + 0.4) + gaze
    target = (np.cos(opposite), np.sin(opposite), 0.95 + 0.5 * np.sin(3 * angle - 0.6) - 0.3 * gaze)
    eye = (radius * np.cos(angle), radius * np.sin(angle), height)
    return look_at(eye, target, roll=0.08 * np.sin(2 * angle + 1.0))


def object_path(s: float, turns: float = 4.0, radius: float = 4.0) -> Array:
    """A spiral from the equator to the pole of a hemisphere around the origin, as Robust e-NeRF's scenes have."""
    return _hemisphere_pose(2 * np.pi * turns * s, 0.5 * np.pi * s, radius, (0.0, 0.0, 0.0))


def object_validation_views(count: int) -> Array:
    """Views (count, 4, 4) all over the hemisphere, on a golden-angle spiral."""
    heights = (np.arange(count) + 0.5) / count
    return _stack([_hemisphere_pose(2.399963 * k, np.arcsin(z), 4.0, (0.0, 0.0, 0.0)) for k, z in enumerate(heights)])


def object_test_views(count: int, seed: int) -> Array:
    """Random views (count, 4, 4) over the hemisphere, at other distances and off-centre."""
    rng = np.random.default_rng(seed)
    return _stack(
        [
            _hemisphere_pose(
                rng.uniform(0, 2 * np.pi),
                np.arcsin(rng.uniform(0, 1)),
                rng.uniform(3.6, 4.4),
                rng.uniform(-0.15, 0.15, 3),
            )
            for _ in range(count)
        ]
    )


def _hemisphere_pose(azimuth: float, elevation: float, radius: float, target: ArrayLike) -> Array:
    outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    eye = radius * (np.cos(elevation) * outward + np.sin(elevation) * np.array([0.0, 0.0, 1.0]))
    # The direction of growing elevation is a vertical that stays defined at the pole.
    up = np.cos(elevation) * np.array([0.0, 0.0, 1.0]) - np.sin(elevation) * outward
    return look_at(eye, target, up)


@dataclass(frozen=True)
class SpeedProfile:
    """When a camera passes each point of its path.

    `easy` runs at constant speed. `hard` runs the same path at the easy speed times 8 ** sin(2 pi t), t in seconds,
    an eighth to eight times as fast (the AE-NeRF paper's two settings).

    Attributes:
        name: "easy" or "hard".
        easy_duration: time the whole path takes at the easy speed, in seconds, for both profiles.

    Raises:
        ValueError: on another name or a duration that is not positive.
    """

    name: str
    easy_duration: float

    def __post_init__(self) -> None:
        if self.name not in ("easy", "hard"):
            raise ValueError(f'speed must be "easy" or "hard", got {self.name!r}')
        if not 0 < self.easy_duration < np.inf:
            raise ValueError(f"duration must be positive, got {self.easy_duration}")

    @property
    def duration(self) -> float:
        """Time the whole path takes, in seconds."""
        return float(self.time(1.0))

    def parameter(self, time: ArrayLike) -> Array:
        """Path parameter at times in seconds, any shape."""
        time = np.asarray(time, np.float64)
        return (time if self.name == "easy" else _hard_advance(time)) / self.easy_duration

    def time(self, parameter: ArrayLike) -> Array:
        """Time in seconds at which path parameters are passed, any shape: the inverse of `parameter`."""
        advance = np.asarray(parameter, np.float64) * self.easy_duration
        if self.name == "easy":
            return advance
        # The advance stays within half a second's worth of its mean: interpolate for a start, then Newton.
        grid = np.arange(advance.min() / HARD_MEAN_SPEED - 1, advance.max() / HARD_MEAN_SPEED + 1, 1e-3)
        time = np.interp(advance, _hard_advance(grid), grid)
        for _ in range(4):
            time = time - (_hard_advance(time) - advance) / HARD_SPEED_RATIO ** np.sin(2 * np.pi * time)
        return time


def _hard_advance(time: Array) -> Array:
    """Integral of 8 ** sin(2 pi t) from 0, by the Jacobi-Anger expansion
    exp(a sin x) = I0(a) + 2 sum_n I_n(a) cos(n (x - pi / 2))."""
    order = np.arange(1, 25)
    weight = 2 * iv(order, np.log(HARD_SPEED_RATIO)) / order
    phase = 2 * np.pi * np.asarray(time)[..., None]
    waves = np.sin(order * (phase - np.pi / 2)) + np.sin(order * np.pi / 2)
    return HARD_MEAN_SPEED * np.asarray(time) + (weight * waves).sum(axis=-1) / (2 * np.pi)
