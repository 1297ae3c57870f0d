"""A stretch of a recording's time, and the gaps in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FIRST_TIME = int(np.iinfo(np.int64).min) + 1
LAST_TIME = int(np.iinfo(np.int64).max) - 1


@dataclass(frozen=True)
class TimeWindow:
    """The times from a start to an end, both included, without those strictly inside a gap.

    Attributes:
        start: nanoseconds.
        end: nanoseconds.
        gaps: (first, last) nanoseconds of each gap, in the order of time. The two times themselves are not in the gap.
    """

    start: int = FIRST_TIME
    end: int = LAST_TIME
    gaps: tuple[tuple[int, int], ...] = ()

    def contains(self, times: ArrayLike) -> NDArray[np.bool_]:
        """Return whether each of (...) times in nanoseconds lies in the window and in no gap."""
        times = np.asarray(times)
        inside = (times >= self.start) & (times <= self.end)
        if self.gaps:
            edges = np.array(self.gaps).ravel()
            before, not_after = np.searchsorted(edges, times), np.searchsorted(edges, times, "right")
            # In a gap, an odd number of ends of gaps is before the time. Two gaps may share an end.
            inside &= (before % 2 == 0) | (before != not_after)
        return inside

    def pieces(self) -> list[tuple[int, int]]:
        """Return the first and the last time of each stretch between the gaps, both included."""
        edges = [self.start, *(time for gap in self.gaps for time in gap), self.end]
        pieces = (
            (max(first, self.start), min(last, self.end)) for first, last in zip(edges[::2], edges[1::2], strict=True)
        )
        return [(first, last) for first, last in pieces if first <= last]


def runs_of(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first index, and the index after the last one, of each run of true values in a mask (N,)."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]
