"""Tables of events: every layout of NumPy's files, HDF5, CSV and text, and columns of any numeric type."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.event_table_writers import (
    HEIGHT,
    WIDTH,
    Columns,
    N,
    made_columns,
    records,
    signed,
    write_csv,
    write_dsec,
    write_eds,
    write_paev3d,
    write_prophesee,
    write_robust_enerf,
    write_text,
    write_tum_vie,
)
from helpers.streams import FUZZ_EXAMPLES, EventsInMemory, make_stream
from hypothesis import given, settings
from hypothesis import strategies as st

from aenerf_ns.errors import DataError
from aenerf_ns.files import event_table, event_text
from aenerf_ns.files.event_arrays import ArrayEventFile
from aenerf_ns.files.event_table import events_from_columns
from aenerf_ns.files.open import open_event_file

MADE = EventsInMemory(make_stream([]))
LAYOUTS: dict[str, tuple[str, Callable[[Path, Columns], object]]] = {
    "Robust e-NeRF": ("raw_events.npz", write_robust_enerf),
    "EventNeRF": ("events.npz", lambda path, columns: np.savez(path, **signed(columns))),
    "compressed": ("events.npz", lambda path, columns: np.savez_compressed(path, **columns)),
    "Fortran order": (
        "raw_events.npz",
        lambda path, c: np.savez(
            path, position=np.array([c["x"], c["y"]]).T, timestamp=c["t"] * 1_000, polarity=c["p"]
        ),
    ),
    "matrix": ("events.npy", lambda path, c: np.save(path, np.stack([c[name] for name in "xytp"], 1).astype(float))),
    "records": ("events.npy", lambda path, columns: np.save(path, records(columns))),
    "DSEC": ("dsec.h5", write_dsec),
    "TUM-VIE": ("tum_vie.h5", write_tum_vie),
    "event_utils": ("utils.h5", lambda path, columns: write_eds(path, {f"events/{c}s": v for c, v in columns.items()})),
    "EDS": ("eds.h5", write_eds),
    "PAEv3D": ("paev3d.hdf5", write_paev3d),
    "Prophesee": ("prophesee.hdf5", write_prophesee),
    "CSV": ("events.csv", write_csv),
    "CSV in seconds": ("events.csv", lambda path, columns: write_csv(path, {**columns, "t": columns["t"] * 1e-6})),
    "text": ("events.txt", lambda path, columns: write_text(path, columns, "{s}.{us:06d} {x} {y} {p}\n")),
    "text with an exponent": ("events.txt", lambda path, c: write_text(path, c, "{t}.00e-6  {x}.0\t{y}e0 {p}\r\n")),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_read_every_layout_in_pieces(layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_table, "CHUNK", 128)
    monkeypatch.setattr(event_text, "BLOCK", 1000)
    name, write = LAYOUTS[layout]
    expected = made_columns()
    write(tmp_path / name, expected)
    events = open_event_file(tmp_path / name, WIDTH, HEIGHT)
    chunks = list(events.chunks())
    for column, values in (("x", expected["x"]), ("y", expected["y"]), ("p", 2 * expected["p"].astype(int) - 1)):
        np.testing.assert_array_equal(np.concatenate([getattr(chunk, column) for chunk in chunks]), values)
    times = np.concatenate([chunk.t for chunk in chunks])
    # The spacing of float64 seconds since 1970 is 238 ns.
    assert np.abs(times - expected["t"] * 1_000).max() <= (500 if layout == "CSV in seconds" else 0)
    assert events.time_span() == (times[0], times[-1])
    assert events.count() in (N, None)
    assert len(chunks) >= 3
    assert max(map(len, chunks)) <= 128


def test_uncompressed_members_are_mapped(tmp_path: Path) -> None:
    write_robust_enerf(tmp_path / "raw_events.npz", made_columns())
    events = open_event_file(tmp_path / "raw_events.npz", WIDTH, HEIGHT)
    assert isinstance(events, ArrayEventFile)
    with events.open_arrays() as arrays:
        assert all(isinstance(array, np.memmap) for array in arrays.values())


NUMBERS = st.sampled_from([np.int8, np.uint8, np.int16, np.uint32, np.int64, np.uint64, np.float32, np.float64, bool])


@settings(max_examples=5 * FUZZ_EXAMPLES, deadline=None)
@given(st.data())
def test_columns_of_any_type_are_read_or_refused(data: st.DataObject) -> None:
    size = data.draw(st.integers(0, 4))
    columns = {}
    for name in "xytp":
        kind = data.draw(NUMBERS)
        small = st.integers(-1, 2) if name != "t" else st.integers(0, 100)
        any_bits = st.binary(min_size=8, max_size=8).map(lambda raw, kind=kind: np.frombuffer(raw, kind)[0])
        values = [data.draw(small | any_bits) for _ in range(size)]
        with np.errstate(all="ignore"):
            columns[name] = np.array(values).astype(kind)
    tick, offset = data.draw(st.sampled_from([1, 1_000, 10**9])), data.draw(st.integers(-(2**62), 2**62))
    try:
        x, y, t, p = events_from_columns(MADE, columns, tick, str, offset)
    except DataError:
        return
    np.testing.assert_array_equal(x, columns["x"])
    np.testing.assert_array_equal(y, columns["y"])
    np.testing.assert_array_equal(p == 1, columns["p"] == 1)
    if columns["t"].dtype.kind != "f":
        assert t.tolist() == [(int(t) + offset) * tick for t in columns["t"]]


@pytest.mark.parametrize("kind", [np.uint8, np.uint64, np.int64, np.float64, bool])
def test_refuse_offset_beyond_the_limit(kind: type) -> None:
    one = {name: np.zeros(1, kind if name == "t" else np.uint8) for name in "xytp"}
    with pytest.raises(DataError, match=r"check the unit of the times \(--event-time-unit of event-recording-data\)"):
        events_from_columns(MADE, one, 10**9, str, 9_223_372_037)
