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
        caster: casts rays against the mesh, or None where all space is free.
        path_size: about the distance of the path from its middle, in meters.
    """

    def __init__(self, caster: RayCaster | None, path_size: float) -> None:
        self._caster = caster
        self._clearance = min(_MAX_CLEARANCE, 0.13 * path_size)

    def is_free(self, eye: ArrayLike) -> bool:
        """Tell whether a position (3,) keeps the clearance."""
        return self._caster is None or bool(self._caster.distance(eye)[0] >= self._clearance)

    def is_reached(self, eye: ArrayLike, home: ArrayLike) -> bool:
        """Tell whether a position (3,) keeps the clearance and sees ``home``: both are on one side of all walls."""
        segment = np.concatenate([np.asarray(home), np.subtract(eye, home)]).astype(np.float32)
        return self.is_free(eye) and (self._caster is None or not self._caster.blocked(segment[None])[0])

    def require_clear(self, path: Callable[[float], NDArray[np.float64]]) -> None:
        """Raise a ValueError if a path passes through a face or comes too close to one."""
        if self._caster is None:
            return
        eyes = np.stack([path(s)[:3, 3] for s in np.linspace(0, 1, _NUM_STEPS + 1)]).astype(np.float32)
        distance = self._caster.distance(eyes)
        through = self._caster.blocked(np.concatenate([eyes[:-1], np.diff(eyes, axis=0)], axis=1))
        if through.any():
            raise ValueError(f"the camera's path runs into the mesh at {eyes[through.argmax()].round(2)}")
        if distance.min() < self._clearance:
            raise ValueError(
                f"the camera's path comes within {distance.min():.3f} m of the mesh at "
                f"{eyes[distance.argmin()].round(2)}; it must keep {self._clearance:.3g} m"
            )
