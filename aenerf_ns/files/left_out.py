"""Events that a reader leaves out because they are malformed, and what else is missing: which, and how many."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError

# Of more than this share a file is not a recording with a few faults, but read wrongly. A few events are always few.
_MAX_SHARE, _FEW = 0.001, 10
# More than there are damaged times in a row.
_NUM_WAITING = 64


class LeftOut:
    """Counts the events that are left out while a file is read, by the reason.

    Attributes:
        waiting: x, y, t and p of the last events of a piece, until the next one tells whether their times are too late.
    """

    def __init__(self) -> None:
        self._printed: set[str] = set()
        self.restart()

    def restart(self) -> None:
        """Forget all counts, because the file is read from its beginning."""
        self._last_time: int | None = None
        self.waiting: list[NDArray] = []
        self._counts: Counter[str] = Counter()
        self._first: dict[str, str] = {}
        self._missing: Counter[str] = Counter()

    def add(self, reason: str, bad: NDArray[np.bool_], describe: Callable[[int], str]) -> None:
        """Count the events of a piece that are left out for a reason; ``describe`` says where one is."""
        if bad.any():
            self.add_number(reason, int(bad.sum()), describe(int(np.argmax(bad))))

    def add_number(self, reason: str, number: int, where: str) -> None:
        """Count events that are left out for a reason, the first of them at a place."""
        self._counts[reason] += number
        self._first.setdefault(reason, where)

    def add_missing(self, what: str, number: int) -> None:
        """Count what a file lacks."""
        self._missing[what] += number

    def in_order(self, columns: Sequence[NDArray]) -> list[NDArray]:
        """Leave out and count the fewest events whose absence leaves the others in order.

        Args:
            columns: x, y, t and p of a piece.

        Returns:
            The columns without these events, and without the last ones: these are ``waiting`` for the next piece.
        """
        if self.waiting:
            columns = [np.concatenate(parts) for parts in zip(self.waiting, columns, strict=True)]
        times = columns[2]
        keep = np.ones(len(times), bool) if self._last_time is None else times >= self._last_time
        if (np.diff(times[keep]) < 0).any():
            keep[keep] = _longest_ordered(times[keep])
        self.add("out of order", ~keep, lambda index: f"at {times[index]} ns")
        columns = [column[keep] for column in columns]
        end = max(len(columns[2]) - _NUM_WAITING, 0)
        self.waiting = [column[end:] for column in columns]
        if end > 0:
            self._last_time = int(columns[2][end - 1])
        return [column[:end] for column in columns]

    def summary(self) -> str:
        """Describe in words what is left out; empty if it is nothing."""
        return ", ".join(f"{n:,} {reason} (the first {self._first[reason]})" for reason, n in self._counts.items())

    def print_once(self, path: Path) -> None:
        """Print what is left out of a file and what it lacks, each line once."""
        summary = self.summary()
        lines = [f"events that are left out: {summary}."] if summary else []
        for line in [*lines, *(f"{what}: {number:,}." for what, number in self._missing.items() if number)]:
            if line not in self._printed:
                self._printed.add(line)
                print(f"{path.name}: {line}")

    def require_few(self, source: Path, num_kept: int) -> None:
        """Raise a DataError if so many events are left out that the file must have been read wrongly."""
        number = self._counts.total()
        if number > max(_FEW, _MAX_SHARE * (num_kept + number)):
            problem = f"{number:,} of its {num_kept + number:,} events are malformed: {self.summary()}"
            remedy = "only a thousandth may be left out: check the sensor's size, the format and the unit of the times"
            raise DataError(source, problem, remedy)


def _longest_ordered(times: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which of (N,) times are in the longest subsequence that never decreases."""
    # For each length, the smallest time that ends such a subsequence, and its index.
    ends: list[int] = []
    indices: list[int] = []
    before = np.empty(len(times), np.int64)
    for index, time in enumerate(times.tolist()):
        length = bisect_right(ends, time)
        before[index] = indices[length - 1] if length else -1
        ends[length : length + 1], indices[length : length + 1] = [time], [index]
    keep = np.zeros(len(times), bool)
    index = indices[-1]
    while index >= 0:
        keep[index] = True
        index = int(before[index])
    return keep
