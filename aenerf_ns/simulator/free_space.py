"""Find out where a camera may be in a mesh."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.simulator.rendering.embree import RayCaster

_MAX_CLEARANCE = 0.15
_NUM_STEPS = 2000


class FreeSpace:
    """The space at a clearance from every face: 0.15 m, or less along a path of less than about a meter.

    Args:
        caster: casts rays against the mesh.
        path_size: about the distance of the path from its middle, in meters.
    """

    def __init__(self, caster: RayCaster, path_size: float) -> None:
        self._caster = caster
        self._clearance = min(_MAX_CLEARANCE, 0.13 * path_size)

    def is_free(self, eye: ArrayLike) -> bool:
        """Tell whether a position (3,) keeps the clearance."""
        return bool(self._caster.distance(eye)[0] >= self._clearance)

    def is_reached(self, eye: ArrayLike, home: ArrayLike) -> bool:
        """Tell whether a position (3,) keeps the clearance and sees ``home``: both are on one side of all walls."""
        segment = np.concatenate([np.asarray(home), np.subtract(eye, home)]).astype(np.float32)
        return self.is_free(eye) and not self._caster.blocked(segment[None])[0]

    def check_path(self, path: Callable[[float], NDArray[np.float64]]) -> None:
        """Raise a ValueError if a path passes through a face or comes too close to one."""
        eyes = np.stack([path(s)[:3, 3] for s in np.linspace(0, 1, _NUM_STEPS + 1)]).astype(np.float32)
        distance = self._caster.distance(eyes)
        through = self._caster.blocked(np.concatenate([eyes[:-1], np.diff(eyes, axis=0)], axis=1))
        if through.any():
            raise ValueError(f"the camera's path runs into the mesh at {_format_point(eyes[through.argmax()])}")
        if distance.min() < self._clearance:
            raise ValueError(
                f"the camera's path comes within {distance.min():.3f} m of the mesh at "
                f"{_format_point(eyes[distance.argmin()])}; it must keep {self._clearance:.3g} m"
            )


def _format_point(point: NDArray[np.float32]) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in point) + ")"
