"""Batches of events and their voxel grids."""

import numpy as np
import pytest
from helpers.streams import make_stream

from aenerf_ns.events.stream import EventStream
from aenerf_ns.reconstruction.batches import batches_of, normalize, voxel_grid

EPOCH = 1_600_000_000_000_000_000


def test_voxel_grid_of_four_events() -> None:
    times = (0, 300_000_000, 500_000_000, 1_000_000_000)
    events = make_stream([(2, 1, EPOCH + t, p) for t, p in zip(times, (1, -1, 1, -1), strict=True)])
    grid = voxel_grid(events, 5)
    assert grid.shape == (5, 3, 4)
    np.testing.assert_allclose(grid[:, 1, 2], [1, -0.8, 0.8, 0, -1], atol=1e-6)
    found = normalize(grid)
    np.testing.assert_allclose(found[:, 1, 2], [1.10432, -0.88345, 0.88345, 0, -1.10432], atol=5e-6)
    assert np.count_nonzero(grid) == np.count_nonzero(found) == 4


def test_equal_times_and_values_stay_finite() -> None:
    grid = voxel_grid(make_stream([(0, 0, EPOCH, 1), (1, 2, EPOCH, 1)]), 5)
    assert grid[0, 0, 0] == grid[0, 2, 1] == 1
    assert np.abs(grid).sum() == 2
    np.testing.assert_array_equal(normalize(grid), np.zeros_like(grid))
    np.testing.assert_array_equal(normalize(np.zeros_like(grid)), np.zeros_like(grid))


@pytest.mark.parametrize("lengths", [[23], [1] * 23, [5, 0, 11, 7], [7, 7, 7, 2]])
def test_batches_are_disjoint_and_in_order(lengths: list[int]) -> None:
    stream = make_stream([(i % 4, i % 3, EPOCH + i, 1 if i % 2 else -1) for i in range(23)])
    ends = np.cumsum(lengths)
    pieces = [stream[end - length : end] for end, length in zip(ends, lengths, strict=True)]
    found: list[EventStream] = list(batches_of(pieces, 7))
    assert [len(batch) for batch in found] == [7, 7, 7]
    for name in "xytp":
        joined = np.concatenate([getattr(batch, name) for batch in found])
        np.testing.assert_array_equal(joined, getattr(stream, name)[:21])
