"""The usual mistakes in a dataset's poses, clock and pixels, and how well each explains the events.

A :class:`Hypothesis` says what the poses, the clock or the pixels might mean instead of what the dataset says. A
:class:`Comparison` says whether the events fit that hypothesis better than what is given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.rotation import quaternion_from_rotation, rotation_from_quaternion
from aenerf_ns.camera.trajectory import homogeneous

# (standard errors, factor): a contrast is clearly higher than another if either pair of limits is exceeded.
_CLEAR = ((4.0, 1.03), (2.5, 1.15))
# Two contrasts that differ by less than this cannot be told apart: standard errors, and factor.
_SAME_ERRORS, _SAME_FACTOR = 2.0, 1.03

CLOCK_OFFSETS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Seconds by which the clock of the poses may be off, in either direction."""

REFINEMENTS = (0.6, 0.7, 0.8, 0.9, 1.2, 1.4, 1.7)
"""Factors of the best clock offset, tried because :data:`CLOCK_OFFSETS` are far apart."""

# Lenses that are closer to the given one sharpen the events nearly as much.
_FOCAL_FACTORS = (0.5, 0.67, 0.8, 1.25, 1.5, 2.0)

# Nanoseconds. Training gives events that an offset moves beyond the ends of the trajectory the pose of the end, so long
# offsets need other times of the poses.
_MAX_LEARNED_OFFSET = 100_000_000


@dataclass(frozen=True)
class Hypothesis:
    """A meaning of the poses, the clock or the pixels other than the given one.

    Attributes:
        name: the mistake in the dataset if the hypothesis holds, worded to follow "as if".
        remedy: how to correct the mistake.
        poses: maps the given (N, 4, 4) poses to the meant ones.
        plane: maps the (height, width, 2) grid of the pixels' directions to the grid of the meant pixels.
        focal_factor: the meant focal lengths by the given ones.
        clock_offset: nanoseconds to add to the time of an event before its pose is looked up.
    """

    name: str
    remedy: str = ""
    poses: Callable[[Tensor], Tensor] = lambda poses: poses
    plane: Callable[[NDArray[np.float64]], NDArray[np.float64]] = lambda plane: plane
    focal_factor: float = 1.0
    clock_offset: int = 0

    @property
    def is_of_series(self) -> bool:
        """Whether it is one of several offsets of the clock, or of several focal lengths, that are tried."""
        return self.clock_offset != 0 or self.focal_factor != 1


def _flip_axes(*signs: float) -> Callable[[Tensor], Tensor]:
    matrix = torch.diag(torch.tensor([*signs, 1.0], dtype=torch.float64))
    return lambda poses: poses @ matrix


def _move_w_last(poses: Tensor) -> Tensor:
    """Return the (N, 4, 4) poses that were meant if qw qx qy qz were read as qx qy qz qw."""
    quaternion = quaternion_from_rotation(poses[:, :3, :3]).roll(-1, -1)
    return homogeneous(torch.cat([rotation_from_quaternion(quaternion), poses[:, :3, 3:]], -1))


def _swap_rows_and_columns(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Exchange rows and columns of the grid; directions of pixels that would leave the sensor are NaN."""
    side = min(plane.shape[:2])
    swapped = np.full_like(plane, np.nan)
    swapped[:side, :side] = plane[:side, :side].transpose(1, 0, 2)
    return swapped


GIVEN = Hypothesis("as given")
"""Poses, clock and pixels mean what the dataset says."""

STILL = Hypothesis("the camera did not move", poses=lambda poses: torch.eye(4).to(poses).expand_as(poses))
"""The camera does not move, so that events are not warped."""

ALTERNATIVES = (
    Hypothesis(
        "the poses have OpenGL camera axes (y up, z backward)",
        "multiply each camera-to-world matrix by diag(1, -1, -1, 1) from the right",
        poses=_flip_axes(1, -1, -1),
    ),
    Hypothesis(
        "the camera axes x and y are flipped (a camera upside down)",
        "multiply each camera-to-world matrix by diag(-1, -1, 1, 1) from the right",
        poses=_flip_axes(-1, -1, 1),
    ),
    Hypothesis(
        "the camera axes x and z are flipped",
        "multiply each camera-to-world matrix by diag(-1, 1, -1, 1) from the right",
        poses=_flip_axes(-1, 1, -1),
    ),
    Hypothesis("the poses are world-to-camera", "invert each: rotation R^T, position -R^T t", poses=torch.linalg.inv),
    Hypothesis(
        "the poses are world-to-camera with OpenGL camera axes",
        "invert each and multiply it by diag(1, -1, -1, 1) from the right",
        poses=lambda poses: _flip_axes(1, -1, -1)(torch.linalg.inv(poses)),
    ),
    Hypothesis("the quaternions have w first", "write them as qx qy qz qw", poses=_move_w_last),
    Hypothesis("the pixels are mirrored in x", "write x as width - 1 - x", plane=lambda plane: plane[:, ::-1]),
    Hypothesis("the pixels are mirrored in y", "write y as height - 1 - y", plane=lambda plane: plane[::-1]),
    Hypothesis("x and y of the events are swapped", "swap the two columns", plane=_swap_rows_and_columns),
    *(
        Hypothesis(
            f"the focal lengths are about {factor:g} times the given ones",
            f"multiply them by about {factor:g}, or calibrate the lens",
            focal_factor=factor,
        )
        for factor in _FOCAL_FACTORS
    ),
)
"""The usual mistakes in poses and pixels."""


def clock_hypothesis(offset: int) -> Hypothesis:
    """Return the hypothesis that an event at time t has the pose of time t + offset, in nanoseconds."""
    seconds, is_ahead = f"{abs(offset) * 1e-9:g} s", offset > 0
    remedy = f"{'subtract' if is_ahead else 'add'} {seconds} {'from' if is_ahead else 'to'} the times of the poses"
    if abs(offset) <= _MAX_LEARNED_OFFSET:
        option = f"--pipeline.model.camera-optimizer.clock-offset {offset * 1e-9:g}"
        remedy += f", or train with {option}, which also learns what is left"
    return Hypothesis(
        f"the clock of the poses is {seconds} {'ahead of' if is_ahead else 'behind'} that of the events",
        remedy,
        clock_offset=offset,
    )


@dataclass(frozen=True)
class Comparison:
    """The contrast of a hypothesis beside that of what is given, over the same events.

    Attributes:
        hypothesis: the hypothesis.
        contrast: the contrast of the events warped under the hypothesis.
        given: the contrast of the events warped as given.
        difference: ``contrast`` less ``given``, in standard errors over the tiles.
        slices_in_favor: indices of the slices of the events that, each by itself, clearly fit the hypothesis better.
    """

    hypothesis: Hypothesis
    contrast: float
    given: float
    difference: float
    slices_in_favor: frozenset[int] = frozenset()

    @property
    def is_clearly_better(self) -> bool:
        """Whether the events clearly fit the hypothesis better than what is given."""
        return _is_clear(self.difference, self.contrast, self.given)

    @property
    def is_clearly_worse(self) -> bool:
        """Whether the events clearly fit what is given better than the hypothesis."""
        return _is_clear(-self.difference, self.given, self.contrast)

    @property
    def is_inconclusive(self) -> bool:
        """Whether the events fit the hypothesis about as well as what is given."""
        return abs(self.difference) < _SAME_ERRORS and _about_equal(self.contrast, self.given)

    def is_like(self, other: Comparison) -> bool:
        """Return whether the events fit another hypothesis about as well."""
        return _about_equal(self.contrast, other.contrast)


def _is_clear(difference: float, higher: float, lower: float) -> bool:
    return any(difference > errors and higher > factor * max(lower, 0) for errors, factor in _CLEAR)


def _about_equal(one: float, other: float) -> bool:
    return abs(one - other) < (_SAME_FACTOR - 1) * max(one, other)
