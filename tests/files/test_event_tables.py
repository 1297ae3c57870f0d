"""Event files of other projects: HDF5, NumPy's files and CSV."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import FUZZ_EXAMPLES
from hypothesis import given, settings
from hypothesis import strategies as st

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.files.event_arrays import NpzEventFile, open_array_events
from aenerf_ns.files.event_hdf5 import Hdf5EventFile, Hdf5EventWriter, open_hdf5_events
from aenerf_ns.files.event_table import events_from_columns
from aenerf_ns.files.open import open_event_file

WIDTH, HEIGHT, N = 60, 40, 300

Columns = dict[str, np.ndarray]


def made_columns() -> Columns:
    """x, y, t in microseconds since 1970, p in {0, 1}."""
    rng = np.random.default_rng(0)
    return {
        "x": rng.integers(0, WIDTH, N).astype(np.uint16),
        "y": rng.integers(0, HEIGHT, N).astype(np.uint16),
        "t": 1_600_000_000_000_000 + np.sort(rng.integers(0, 5_000_000, N)),
        "p": rng.integers(0, 2, N).astype(np.uint8),
    }


def write_dsec(path: Path, columns: Columns, **filters: object) -> None:
    offset = int(columns["t"][0]) - 7
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            values = (values - offset).astype(np.uint32) if name == "t" else values
            file.create_dataset(f"events/{name}", data=values, **filters)
        file["ms_to_idx"] = np.zeros(3, np.uint64)
        file["t_offset"] = offset


def write_tum_vie(path: Path, columns: Columns) -> None:
    hdf5plugin = pytest.importorskip("hdf5plugin", reason="the extra hdf5-filters is not installed")
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, chunks=(64,), **hdf5plugin.Blosc())
        file["ms_to_idx"] = np.zeros(3, np.uint64)


def write_eds(path: Path, columns: Columns) -> None:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values


def write_paev3d(path: Path, columns: Columns) -> None:
    with h5py.File(path, "w") as file:
        file["events"] = np.stack([columns[name] for name in "txyp"], 1).astype(np.float64)


def records(columns: Columns) -> np.ndarray:
    table = np.zeros(N, dtype=[("x", np.uint16), ("y", np.uint16), ("p", np.int16), ("t", np.int64)])
    for name, values in columns.items():
        table[name] = values
    return table


def write_prophesee(path: Path, columns: Columns) -> None:
    with h5py.File(path, "w") as file:
        file["CD/events"] = records(columns)


def write_robust_enerf(path: Path, columns: Columns) -> None:
    position = np.stack([columns["x"], columns["y"]], 1)
    np.savez(path, position=position, timestamp=columns["t"] * 1_000, polarity=columns["p"].astype(bool))


def signed(columns: Columns) -> Columns:
    return {**columns, "p": 2 * columns["p"].astype(np.int8) - 1}


def write_csv(path: Path, columns: Columns) -> None:
    order = ("t", "p", "x", "y")
    rows = zip(*(columns[name].tolist() for name in order), strict=True)
    path.write_text("# made\n" + "\n".join(", ".join(map(str, row)) for row in [order, *rows]) + "\n")


LAYOUTS: dict[str, tuple[str, Callable[[Path, Columns], object]]] = {
    "DSEC": ("dsec.h5", write_dsec),
    "TUM-VIE": ("tum_vie.h5", write_tum_vie),
    "EDS": ("eds.h5", write_eds),
    "PAEv3D": ("paev3d.hdf5", write_paev3d),
    "Prophesee": ("prophesee.hdf5", write_prophesee),
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
    "CSV": ("events.csv", write_csv),
    "CSV in seconds": ("events.csv", lambda path, columns: write_csv(path, {**columns, "t": columns["t"] * 1e-6})),
}


def open_events(path: Path) -> EventFile:
    return (open_hdf5_events if path.suffix in (".h5", ".hdf5") else open_array_events)(path, WIDTH, HEIGHT)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_events_it_was_written_with(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Several pieces.
    monkeypatch.setattr("aenerf_ns.files.event_table._CHUNK", 128)
    monkeypatch.setattr("aenerf_ns.files.event_arrays._CHUNK_LINES", 128)
    name, write = LAYOUTS[layout]
    expected = made_columns()
    write(tmp_path / name, expected)
    events = open_events(tmp_path / name)
    chunks = list(events.chunks())
    assert [len(chunk) for chunk in chunks] == [128, 128, 44]
    for column, values in (("x", expected["x"]), ("y", expected["y"]), ("p", 2 * expected["p"].astype(int) - 1)):
        np.testing.assert_array_equal(np.concatenate([getattr(chunk, column) for chunk in chunks]), values)
    # The spacing of float64 seconds since 1970 is 238 ns.
    error = np.abs(np.concatenate([chunk.t for chunk in chunks]) - expected["t"] * 1_000).max()
    assert error <= (500 if layout == "CSV in seconds" else 0)
    assert events.time_span() == (chunks[0].t[0], chunks[-1].t[-1])
    assert events.count() in (N, None)


def test_a_native_file_is_told_from_others(tmp_path: Path) -> None:
    columns = signed(made_columns())
    with Hdf5EventWriter(tmp_path / "events.h5") as writer:
        writer.append(EventStream(**columns, width=WIDTH, height=HEIGHT))
    events = open_events(tmp_path / "events.h5")
    assert isinstance(events, Hdf5EventFile)
    # Its times are nanoseconds; those of a file with DSEC's index are microseconds whatever the types.
    assert events.time_span()[0] == columns["t"][0]
    with h5py.File(tmp_path / "events.h5", "a") as file:
        file["ms_to_idx"] = np.zeros(3)
    assert open_events(tmp_path / "events.h5").time_span()[0] == columns["t"][0] * 1_000


def test_the_unit_of_times_may_be_given(tmp_path: Path) -> None:
    columns = {**made_columns(), "t": np.arange(N)}
    np.savez(tmp_path / "events.npz", **columns)
    write_csv(tmp_path / "events.csv", columns)
    for name in ("events.npz", "events.csv"):
        assert open_array_events(tmp_path / name, WIDTH, HEIGHT).time_span() == (0, 299_000)
        assert open_array_events(tmp_path / name, WIDTH, HEIGHT, "ns").time_span() == (0, 299)
        assert open_array_events(tmp_path / name, WIDTH, HEIGHT, "s").time_span() == (0, 299 * 10**9)


@pytest.mark.parametrize("name", ["events.csv", "EVENTS.CSV"])
def test_decimals_behind_a_whole_number_in_csv_are_kept(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text("x,y,t,p\n1,2,0,1\n3,2,0.000123,0\n3,2,0.25,1\n1,2,1.5,0\n")
    file = open_array_events(path, WIDTH, HEIGHT)
    (events,) = file.chunks()
    assert events.t.tolist() == [0, 123_000, 250_000_000, 1_500_000_000]
    assert file.time_span() == (0, 1_500_000_000)


def test_a_stated_unit_counts_where_the_file_states_none(tmp_path: Path) -> None:
    columns = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.int8}
    with h5py.File(tmp_path / "events.h5", "w") as file:
        for name, dtype in columns.items():
            file[f"events/{name}"] = np.array([1, 1_000_000] if name == "t" else [1, 1], dtype)
    path = tmp_path / "events.h5"
    assert open_hdf5_events(path, WIDTH, HEIGHT).time_span() == (1, 1_000_000)
    assert open_hdf5_events(path, WIDTH, HEIGHT, "us").time_span() == (1_000, 1_000_000_000)
    with h5py.File(path, "a") as file:
        file["events"].attrs["time_unit"] = "ns"
    with pytest.raises(DataError, match="it states its time unit, 'ns', but us was given"):
        open_hdf5_events(path, WIDTH, HEIGHT, "us").time_span()
    (tmp_path / "events.txt").write_text("0.1 1 2 1\n")
    with pytest.raises(DataError, match="its format has a time unit, but us was given"):
        open_event_file(tmp_path / "events.txt", WIDTH, HEIGHT, time_unit="us")


def test_whole_numbers_in_csv_are_exact_beyond_float64(tmp_path: Path) -> None:
    path = tmp_path / "events.csv"
    path.write_text("x,y,t,p\n1,2,1600000000123456789,1\n")
    assert open_array_events(path, WIDTH, HEIGHT, "ns").time_span()[0] == 1_600_000_000_123_456_789


def test_members_that_are_not_compressed_are_not_read_at_once(tmp_path: Path) -> None:
    write_robust_enerf(tmp_path / "raw_events.npz", made_columns())
    events = open_events(tmp_path / "raw_events.npz")
    assert isinstance(events, NpzEventFile)
    with events.open_arrays() as arrays:
        assert all(isinstance(array, np.memmap) for array in arrays.values())


def write_with_filter(path: Path, code: int) -> None:
    """Events in a compression for which no filter exists here."""
    with h5py.File(path, "w") as file:
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk((N,))
        settings.set_filter(code, h5py.h5z.FLAG_OPTIONAL, ())
        kind = h5py.h5t.py_create(records(made_columns()).dtype)
        group = file.create_group("CD")
        dataset = h5py.h5d.create(group.id, b"events", kind, h5py.h5s.create_simple((N,)), settings)
        dataset.write_direct_chunk((0,), b"compressed", 0)


def replaced(name: str, values: np.ndarray | None) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        columns = made_columns()
        if values is None:
            del columns[name]
        else:
            columns[name] = values
        if path.suffix == ".h5":
            write_eds(path, columns)
        else:
            np.savez(path, **columns)

    return write


T = made_columns()["t"]
ZEROS = np.zeros(N, np.int64)
FAULTS: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "no HDF5 file": ("e.h5", lambda path: None, "e.h5: there is no such event file"),
    "no array file": ("e.npz", lambda path: None, "e.npz: there is no such event file"),
    "no .npy file": ("e.npy", lambda path: None, "e.npy: there is no such event file"),
    "no CSV": ("e.csv", lambda path: None, "e.csv: there is no such event file"),
    "text as HDF5": ("e.h5", lambda path: path.write_text("x y"), "e.h5: not a readable HDF5 file"),
    "text as npz": ("e.npz", lambda path: path.write_text("x y"), "e.npz: not a readable .npz file"),
    "text as npy": ("e.npy", lambda path: path.write_text("x y"), "e.npy: not a readable .npy file"),
    "empty npy": ("e.npy", lambda path: path.write_bytes(b""), "e.npy: not a readable .npy file"),
    "empty CSV": ("e.csv", lambda path: path.write_text(""), "its first line is ''; it must name the columns"),
    "CSV without header": ("e.csv", lambda path: path.write_text("1,2,3,1\n"), "first line is '1,2,3,1'; it must name"),
    "CSV without events": ("e.csv", lambda path: path.write_text("x,y,t,p\n"), "e.csv: the file holds no events"),
    "CSV with a word": ("e.csv", lambda path: path.write_text("x,y,t,p\n1,2,now,1\n"), "what is not a number"),
    "CSV with five": ("e.csv", lambda path: path.write_text("x,y,t,p\n1,2,3,1,9\n"), "5 fields, its header 4"),
    "truncated npz": (
        "e.npz",
        lambda path: (np.savez(path, **made_columns()), path.write_bytes(path.read_bytes()[:900])),
        "e.npz: not a readable .npz file",
    ),
    "damaged npz": (
        "e.npz",
        lambda path: (
            np.savez_compressed(path, **made_columns()),
            path.write_bytes(path.read_bytes()[:200] + b"?" * 100 + path.read_bytes()[300:]),
        ),
        "e.npz: its array x cannot be read",
    ),
    "array of objects": (
        "e.npz",
        replaced("x", np.array([object] * N)),
        "e.npz: its array x cannot be read .*allow_pickle",
    ),
    "no events in HDF5": ("e.h5", replaced("p", None), "e.h5: it holds t, x, y; events must be in"),
    "no events in npz": ("e.npz", replaced("p", None), "e.npz: its arrays are t, x, y; it must hold x, y, t and p"),
    "empty HDF5": ("e.h5", lambda path: h5py.File(path, "w").close(), "e.h5: it holds nothing"),
    "empty stream": (
        "e.npz",
        lambda path: np.savez(path, **{name: np.zeros(0) for name in "xytp"}),
        "the file holds no events",
    ),
    "short column": ("e.h5", replaced("x", np.zeros(3, int)), "its columns have lengths"),
    "matrix as column": ("e.npz", replaced("x", np.zeros((N, 2), int)), r"x has shape \(300, 2\)"),
    "three columns": ("e.npy", lambda path: np.save(path, np.zeros((9, 3))), "has 3 columns; column 3 must hold p"),
    "one column": ("e.npy", lambda path: np.save(path, np.zeros(9)), r"has shape \(9,\)"),
    "records without p": (
        "e.npy",
        lambda path: np.save(path, np.zeros(9, [("x", "u2"), ("y", "u2"), ("t", "i8")])),
        "have no field p",
    ),
    "words": ("e.npz", replaced("x", np.array(["one"] * N)), "column x has type <U3; store numbers"),
    "pixel outside": ("e.h5", replaced("x", ZEROS + WIDTH), "event 0 has x = 60; it must be a whole number below 60"),
    "negative pixel": ("e.h5", replaced("y", ZEROS - 1), "event 0 has y = -1"),
    "fractional pixel": ("e.npz", replaced("y", ZEROS + 0.5), "event 0 has y = 0.5; it must be a whole number"),
    "polarity 2": ("e.h5", replaced("p", ZEROS + 2), "event 0 has p = 2; polarities are 0 and 1, or -1 and 1"),
    "three polarities": ("e.npz", replaced("p", np.arange(N) % 3 - 1), "event 1 has p = 0; .* -1 beside it"),
    "NaN time": ("e.npz", replaced("t", np.full(N, np.nan)), "event 0 has t = nan; check the unit"),
    "huge time": ("e.h5", replaced("t", T * 1_000), r"event 0 has t = 1\.6e\+18; check the unit"),
    "unsorted": ("e.npz", replaced("t", T[::-1].copy()), "sort the events by time"),
    "offset is a word": (
        "e.h5",
        lambda path: (write_dsec(path, made_columns()), set_offset(path, "late")),
        "its t_offset is .*late.*; store an integer",
    ),
    "ECF": ("e.h5", lambda path: write_with_filter(path, 0x8ECF), "ECF filter: .* set HDF5_PLUGIN_PATH to its folder"),
    "another filter": ("e.h5", lambda path: write_with_filter(path, 40_000), r"pip install 'aenerf-ns\[hdf5-"),
}


def set_offset(path: Path, value: object) -> None:
    with h5py.File(path, "a") as file:
        del file["t_offset"]
        file["t_offset"] = value


def read_everything(path: Path) -> None:
    events = open_events(path)
    events.time_span()
    assert list(events.chunks())


@pytest.mark.parametrize("fault", FAULTS)
def test_malformed_event_files_are_one_clear_line(fault: str, tmp_path: Path) -> None:
    name, write, message = FAULTS[fault]
    write(tmp_path / name)
    with pytest.raises(DataError, match=message) as error:
        read_everything(tmp_path / name)
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)


def test_blosc_without_its_filter_names_the_extra(tmp_path: Path) -> None:
    write_tum_vie(tmp_path / "events.h5", made_columns())
    # In a process of its own, for a filter that is loaded stays.
    code = (
        "import sys; from pathlib import Path; sys.modules['hdf5plugin'] = None\n"
        "from aenerf_ns.files.event_hdf5 import open_hdf5_events\n"
        f"open_hdf5_events(Path({str(tmp_path / 'events.h5')!r}), {WIDTH}, {HEIGHT}).time_span()"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True)
    assert "pip install 'aenerf-ns[hdf5-filters]'" in done.stderr.splitlines()[-1]


@settings(max_examples=5 * FUZZ_EXAMPLES, deadline=None)
@given(st.text(alphabet='xytp,0123456789.-+e#\n" nai²', max_size=80), st.booleans())
def test_no_text_crashes_the_csv_reader(tmp_path_factory: pytest.TempPathFactory, text: str, header: bool) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.csv"
    path.write_text("x,y,t,p\n" * header + text, encoding="utf-8")
    for read in (lambda events: list(events.chunks()), lambda events: events.time_span()):
        try:
            read(open_array_events(path, WIDTH, HEIGHT))
        except DataError as error:
            assert "\n" not in str(error)  # noqa: PT017


NUMBERS = st.sampled_from([np.int8, np.uint8, np.int16, np.uint32, np.int64, np.uint64, np.float32, np.float64, bool])


@settings(max_examples=5 * FUZZ_EXAMPLES, deadline=None)
@given(st.data())
def test_columns_of_any_type_give_events_or_a_clear_error(data: st.DataObject) -> None:
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
        events = events_from_columns(columns, width=4, height=3, tick=tick, offset=offset, source="made")
    except DataError:
        return
    for name in "xy":
        np.testing.assert_array_equal(getattr(events, name), columns[name])
    np.testing.assert_array_equal(events.p == 1, columns["p"] == 1)
    if columns["t"].dtype.kind != "f":
        assert events.t.tolist() == [(int(t) + offset) * tick for t in columns["t"]]


@pytest.mark.parametrize("kind", [np.uint8, np.uint64, np.int64, np.float64, bool])
def test_an_offset_beyond_the_limit_leaves_no_good_time(kind: type) -> None:
    one = {name: np.zeros(1, kind if name == "t" else np.uint8) for name in "xytp"}
    with pytest.raises(DataError, match="check the unit of the times"):
        events_from_columns(one, width=4, height=3, tick=10**9, offset=9_223_372_037, source="made")
