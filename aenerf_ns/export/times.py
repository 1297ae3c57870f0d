"""Times along the trajectory of a run at which frames are rendered."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.errors import DataError
from aenerf_ns.files.limits import MAX_ROWS
from aenerf_ns.files.text import format_seconds, parse_times


def spread_times(window: TimeWindow, count: int) -> Tensor:
    """Spread (count,) times in nanoseconds evenly over a time window, its gaps left out."""
    starts, ends = torch.tensor(window.pieces()).T
    elapsed = (ends - starts).cumsum(0)
    # The times are in the middles of equal parts.
    middles = ((torch.arange(count, dtype=torch.float64) + 0.5) * (int(elapsed[-1]) / count)).long()
    piece = torch.searchsorted(elapsed, middles, right=True)
    return ends[piece] - (elapsed[piece] - middles)


def times_at_rate(window: TimeWindow, rate: float) -> Tensor:
    """Return times in nanoseconds, at a rate per second, in a time window but not in its gaps.

    Raises:
        DataError: the rate gives no time, or more than a reader of trajectories takes.
    """
    count = (window.end - window.start) * 1e-9 * rate
    if count > MAX_ROWS:
        raise DataError("--rate", f"{rate:g} gives {count:.3g} times", f"give one that gives at most {MAX_ROWS:,}")
    times = torch.arange(window.start, window.end + 1, round(1e9 / rate))
    times = times[torch.from_numpy(window.contains(times))]
    if len(times) == 0:
        raise DataError("--rate", f"{rate:g} gives no time at which poses are known", "give a higher one")
    return times


def times_from_seconds(window: TimeWindow, seconds: Sequence[str]) -> Tensor:
    """Convert decimal times in seconds on the clock of the events to nanoseconds, exactly.

    Raises:
        DataError: a time is not a number, or not in the time window of the run.
    """
    times = parse_times(Path("--times"), seconds)
    for value, inside in zip(seconds, window.contains(times), strict=True):
        if not inside:
            raise DataError(
                "--times",
                f"{value} s is not in the run's time, {format_seconds(window.start)} to {format_seconds(window.end)} s",
                "give times on the clock of the events, in which poses are known",
            )
    return torch.from_numpy(times)
