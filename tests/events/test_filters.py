"""Event filters: the same as the slow and obvious way, however the stream is cut."""

import numpy as np
import pytest
from helpers.streams import EventsInMemory, make_stream, sorted_rows, unpacked
from hypothesis import given, settings
from hypothesis import strategies as st

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.events.filters import EventFilters, EventSelection, count_events, find_hot_pixels
from aenerf_ns.events.pairing import pair_events
from aenerf_ns.files.event_reader import EventFile

WIDTH, HEIGHT = 6, 5
Row = tuple[int, int, int, int]
EVENTS = sorted_rows(WIDTH, HEIGHT)


def file_of(rows: list[Row], *sizes: int) -> EventFile:
    return EventsInMemory(make_stream(rows, WIDTH, HEIGHT), sizes)


def kept_of(event_file: EventFile, filters: EventFilters) -> list[Row]:
    selection = EventSelection(event_file.path, WIDTH, HEIGHT, filters)
    selection.find_hot_pixels(event_file.chunks())
    chunks = list(selection.filtered(event_file.chunks()))
    size = filters.region[2:] if filters.region else (WIDTH, HEIGHT)
    assert all((chunk.width, chunk.height) == size for chunk in chunks)
    columns = (np.concatenate([getattr(chunk, name) for chunk in chunks]).tolist() for name in "xytp")
    return list(zip(*columns, strict=True))


def kept_by_brute_force(rows: list[Row], filters: EventFilters, keep: set[tuple[int, int]]) -> list[Row]:
    """The rows that stay, the slow and obvious way; ``keep`` are the pixels that stay."""
    result: list[Row] = []
    x0, y0 = filters.region[:2] if filters.region else (0, 0)
    for x, y, t, p in rows:
        if filters.start is not None and t < filters.start:
            continue
        if filters.end is not None and t > filters.end:
            continue
        before = [row[2] for row in result if row[:2] == (x, y)]
        if (x, y) in keep and not (before and t - before[-1] < filters.shortest_interval):
            result.append((x, y, t, p))
    return [(x - x0, y - y0, t, p) for x, y, t, p in result]


@settings(max_examples=200, deadline=None)
@given(
    EVENTS,
    st.lists(st.integers(0, 20), max_size=6),
    st.none() | st.integers(0, 15),
    st.none() | st.integers(15, 31),
    st.none() | st.tuples(st.integers(0, 2), st.integers(0, 2), st.integers(1, 4), st.integers(1, 3)),
    st.integers(0, 6),
)
def test_filters_are_those_of_brute_force_however_the_stream_is_cut(
    rows: list[Row],
    sizes: list[int],
    start: int | None,
    end: int | None,
    region: tuple[int, int, int, int] | None,
    shortest_interval: int,
) -> None:
    filters = EventFilters(start=start, end=end, region=region, shortest_interval=shortest_interval)
    x0, y0, width, height = region or (0, 0, WIDTH, HEIGHT)
    keep = {(x, y) for x in range(x0, x0 + width) for y in range(y0, y0 + height)}
    assert kept_of(file_of(rows, *sizes), filters) == kept_by_brute_force(rows, filters, keep)


@settings(max_examples=50, deadline=None)
@given(EVENTS, st.lists(st.integers(0, 20), max_size=6), st.floats(0.1, 0.9), st.integers(0, 3))
def test_a_share_of_the_pixels_keeps_all_their_events_and_so_their_pairs(
    rows: list[Row], sizes: list[int], share: float, seed: int
) -> None:
    kept = kept_of(file_of(rows, *sizes), EventFilters(pixel_share=share, seed=seed))
    pixels = {row[:2] for row in kept}
    assert kept == [row for row in rows if row[:2] in pixels]
    assert kept == kept_of(file_of(rows), EventFilters(pixel_share=share, seed=seed))
    if kept:
        # Every pair of the filtered stream is one of the whole stream.
        pairs, whole = (pair_events([make_stream(part, WIDTH, HEIGHT)]) for part in (kept, rows))
        assert set(unpacked(pairs)) <= set(unpacked(whole))


def test_the_share_of_pixels_is_as_asked_and_seeded() -> None:
    everywhere = [(x, y, 0, 1) for y in range(HEIGHT) for x in range(WIDTH)]

    def pixels(seed: int) -> list[Row]:
        return kept_of(file_of(everywhere), EventFilters(pixel_share=0.5, seed=seed))

    assert len({tuple(pixels(seed)) for seed in range(5)}) == 5
    assert np.mean([len(pixels(seed)) for seed in range(200)]) == pytest.approx(0.5 * len(everywhere), rel=0.05)


def test_planted_hot_pixels_are_found_and_no_others() -> None:
    rng = np.random.default_rng(0)
    # A scene whose event density varies smoothly by a factor of 30, with Poisson noise.
    columns, rows = np.meshgrid(np.arange(80), np.arange(60))
    density = 3 * np.exp(1.7 * (np.sin(columns / 7) + np.cos(rows / 9)))
    counts = rng.poisson(density)
    hot = np.zeros(counts.shape, bool)
    hot[[0, 20, 21, 59, 40], [0, 30, 31, 79, 12]] = True
    counts[hot] = 12 * density[hot] + 200
    assert (find_hot_pixels(counts) == hot).all()
    assert not find_hot_pixels(np.zeros((10, 10), np.int64)).any()


@pytest.mark.parametrize("share", [0.05, 0.25, 0.4, 0.5, 0.6, 0.8])
def test_pixels_between_removed_ones_are_not_hot(share: float) -> None:
    rng = np.random.default_rng(1)
    counts = rng.poisson(60, (60, 80)) * (rng.random((60, 80)) < share)
    counts[30, 40] = 2000
    assert np.argwhere(find_hot_pixels(counts)).tolist() == [[30, 40]]


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_a_filter_that_alone_sees_light_is_not_hot(share: float) -> None:
    counts = np.random.default_rng(2).poisson(60 * share, (60, 80))
    counts[::2, :40:2] += np.random.default_rng(3).poisson(60, (30, 20))
    counts[30, 20] = 2000
    assert np.argwhere(find_hot_pixels(counts, "RGGB")).tolist() == [[30, 20]]


def test_a_strip_of_a_color_sensor_lacks_filters() -> None:
    assert not find_hot_pixels(np.ones((1, 9), np.int64), "RGGB").any()


def test_hot_pixels_are_left_out_and_told() -> None:
    rng = np.random.default_rng(0)
    rows = [(int(x), int(y), 2 * i, 1) for i, (x, y) in enumerate(rng.integers(0, (WIDTH, HEIGHT), (300, 2)))]
    rows += [(4, 2, 2 * i + 1, 1) for i in range(300)]
    rows.sort(key=lambda row: row[2])
    file, filters = file_of(rows, 100, 0, 200), EventFilters(hot_pixels=True)
    assert kept_of(file, filters) == [row for row in rows if row[:2] != (4, 2)]
    selection, count = EventSelection(file.path, WIDTH, HEIGHT, filters), sum(row[:2] == (4, 2) for row in rows)
    told = f"Hot pixels: 1, with {count / 600:.2%} of the events. (x, y) and events: (4, 2) {count}."
    assert selection.find_hot_pixels(file.chunks()) == told
    # Only the time window counts: within it the pixel is as the others.
    quiet = [row for row in rows if row[:2] != (4, 2) or row[2] < 300]
    filters = EventFilters(start=301, hot_pixels=True)
    assert kept_of(file_of(quiet), filters) == [row for row in quiet if row[2] >= 301]


def test_a_cropped_camera_sees_the_same_directions() -> None:
    camera = CameraIntrinsics(12, 10, 8.0, 8.5, 6.2, 4.9, "radial_tangential", (-0.1, 0.02, 0.001, 0.0, 0.0))
    cropped = camera.crop(3, 2, 7, 5)
    assert (cropped.width, cropped.height) == (7, 5)
    expected = camera.pixel_directions()[0][2:7, 3:10]
    np.testing.assert_allclose(cropped.pixel_directions()[0], expected, rtol=0, atol=1e-12)


def test_events_are_counted_on_a_sensor_of_more_pixels_than_16_bits_hold() -> None:
    events = make_stream([(1279, 719, 0, 1), (3, 700, 1, 1), (1279, 719, 2, 1)], 1280, 720)
    counts = count_events([events, events], 720, 1280)
    assert (counts[719, 1279], counts[700, 3], counts.sum()) == (4, 2, 6)
