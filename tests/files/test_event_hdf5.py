"""Events in HDF5: the native file and those of other projects."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.event_table_writers import (
    HEIGHT,
    WIDTH,
    ZEROS,
    Columns,
    N,
    T,
    assert_fault_is_one_line,
    lengths_of_read_pieces,
    made_columns,
    records,
    replaced,
    signed,
    write_dsec,
    write_eds,
    write_paev3d,
    write_prophesee,
    write_tum_vie,
)

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.files import event_table
from aenerf_ns.files.event_hdf5 import Hdf5EventFile, Hdf5EventWriter, open_hdf5_events
from aenerf_ns.files.open import open_event_file


def open_events(path: Path) -> EventFile:
    return open_hdf5_events(path, WIDTH, HEIGHT)


LAYOUTS: dict[str, tuple[str, Callable[[Path, Columns], object]]] = {
    "DSEC": ("dsec.h5", write_dsec),
    "TUM-VIE": ("tum_vie.h5", write_tum_vie),
    "EDS": ("eds.h5", write_eds),
    "PAEv3D": ("paev3d.hdf5", write_paev3d),
    "Prophesee": ("prophesee.hdf5", write_prophesee),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_events_it_was_written_with(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Several pieces.
    monkeypatch.setattr(event_table, "CHUNK", 128)
    name, write = LAYOUTS[layout]
    assert lengths_of_read_pieces(tmp_path / name, write, open_events) == [128, 128, 44]


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


def set_offset(path: Path, value: object) -> None:
    with h5py.File(path, "a") as file:
        del file["t_offset"]
        file["t_offset"] = value


FAULTS: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "no HDF5 file": ("e.h5", lambda path: None, "e.h5: there is no such file"),
    "text as HDF5": ("e.h5", lambda path: path.write_text("x y"), "e.h5: not a readable HDF5 file"),
    "no events in HDF5": ("e.h5", replaced("p", None), "e.h5: it holds t, x, y; events must be in"),
    "empty HDF5": ("e.h5", lambda path: h5py.File(path, "w").close(), "e.h5: it holds nothing"),
    "short column": ("e.h5", replaced("x", np.zeros(3, int)), "its columns have lengths"),
    "pixel outside": ("e.h5", replaced("x", ZEROS + WIDTH), "event 0 has x = 60; it must be a whole number below 60"),
    "negative pixel": ("e.h5", replaced("y", ZEROS - 1), "event 0 has y = -1"),
    "polarity 2": ("e.h5", replaced("p", ZEROS + 2), "event 0 has p = 2; polarities are 0 and 1, or -1 and 1"),
    "huge time": ("e.h5", replaced("t", T * 1_000), r"event 0 has t = 1\.6e\+18; check the unit"),
    "offset is a word": (
        "e.h5",
        lambda path: (write_dsec(path, made_columns()), set_offset(path, "late")),
        "its t_offset is .*late.*; store an integer",
    ),
    "ECF": ("e.h5", lambda path: write_with_filter(path, 0x8ECF), "ECF filter: .* set HDF5_PLUGIN_PATH to its folder"),
    "another filter": ("e.h5", lambda path: write_with_filter(path, 40_000), r"pip install 'aenerf-ns\[hdf5-"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_malformed_event_files_are_one_clear_line(fault: str, tmp_path: Path) -> None:
    name, write, message = FAULTS[fault]
    assert_fault_is_one_line(tmp_path / name, write, message, open_events)


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
