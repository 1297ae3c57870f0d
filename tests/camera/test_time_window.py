"""Time windows with gaps, against brute force over every nanosecond."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aenerf_ns.camera.time_window import FIRST_TIME, LAST_TIME, TimeWindow

# Windows and gaps that overlap in all ways, on a scale on which every nanosecond can be tried.
MOMENTS = range(-3, 34)


@st.composite
def windows(draw: st.DrawFn) -> TimeWindow:
    """Windows with gaps in the order of time. Gaps may touch each other, reach out of the window, or lie outside it."""
    edges = sorted(draw(st.lists(st.integers(0, 30), max_size=8)))
    gaps = [gap for gap in zip(edges[::2], edges[1::2], strict=False) if gap[0] < gap[1]]
    start, end = sorted((draw(st.integers(0, 30)), draw(st.integers(0, 30))))
    return TimeWindow(start, end, tuple(gaps))


def is_inside(window: TimeWindow, time: int) -> bool:
    """The definition, for one time: both ends are included, and a gap's own ends are no part of the gap."""
    return window.start <= time <= window.end and not any(first < time < last for first, last in window.gaps)


@given(windows())
def test_a_window_and_its_pieces_contain_the_times_that_are_in_no_gap(window: TimeWindow) -> None:
    expected = [is_inside(window, time) for time in MOMENTS]
    assert window.contains(MOMENTS).tolist() == expected
    assert [bool(window.contains(time)) for time in MOMENTS] == expected
    times = np.array(MOMENTS[:36]).reshape(4, 3, 3)
    np.testing.assert_array_equal(window.contains(times), np.reshape(expected[:36], (4, 3, 3)))
    pieces = window.pieces()
    assert all(first <= last for first, last in pieces)
    assert all(before[1] <= after[0] for before, after in pairwise(pieces))
    covered = {time for first, last in pieces for time in range(first, last + 1)}
    assert covered == {time for time, inside in zip(MOMENTS, expected, strict=True) if inside}
    # No piece reaches over a gap.
    for first, last in pieces:
        assert not any(first <= gap[0] and gap[1] <= last for gap in window.gaps)


@pytest.mark.parametrize("window", [TimeWindow(), TimeWindow(gaps=((3, 5),))])
def test_without_an_end_a_window_contains_all_times(window: TimeWindow) -> None:
    assert window.contains([FIRST_TIME, 3, 5, LAST_TIME]).all()
    assert window.contains(4) == (not window.gaps)
    pieces = window.pieces()
    assert (pieces[0][0], pieces[-1][1]) == (FIRST_TIME, LAST_TIME)
    # Their neighbors still fit in 64 bits, as EventStream.between needs.
    limits = np.iinfo(np.int64)
    assert limits.min < FIRST_TIME < LAST_TIME < limits.max
