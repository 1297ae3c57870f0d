"""Events in NumPy's files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

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
    write_robust_enerf,
)

from aenerf_ns.events.stream import EventFile
from aenerf_ns.files import event_table
from aenerf_ns.files.event_arrays import NpzEventFile, open_array_events
from aenerf_ns.files.text import TimeUnit


def open_events(path: Path) -> EventFile:
    return open_array_events(path, WIDTH, HEIGHT)


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
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_events_it_was_written_with(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Several pieces.
    monkeypatch.setattr(event_table, "CHUNK", 128)
    name, write = LAYOUTS[layout]
    assert lengths_of_read_pieces(tmp_path / name, write, open_events) == [128, 128, 44]


@pytest.mark.parametrize(("unit", "end"), [(None, 299_000), ("ns", 299), ("s", 299 * 10**9)])
def test_the_unit_of_times_may_be_given(unit: TimeUnit | None, end: int, tmp_path: Path) -> None:
    np.savez(tmp_path / "events.npz", **{**made_columns(), "t": np.arange(N)})
    assert open_array_events(tmp_path / "events.npz", WIDTH, HEIGHT, unit).time_span() == (0, end)


def test_members_that_are_not_compressed_are_not_read_at_once(tmp_path: Path) -> None:
    write_robust_enerf(tmp_path / "raw_events.npz", made_columns())
    events = open_events(tmp_path / "raw_events.npz")
    assert isinstance(events, NpzEventFile)
    with events.open_arrays() as arrays:
        assert all(isinstance(array, np.memmap) for array in arrays.values())


FAULTS: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "no array file": ("e.npz", lambda path: None, "e.npz: there is no such file"),
    "no .npy file": ("e.npy", lambda path: None, "e.npy: there is no such file"),
    "text as npz": ("e.npz", lambda path: path.write_text("x y"), "e.npz: not a readable .npz file"),
    "text as npy": ("e.npy", lambda path: path.write_text("x y"), "e.npy: not a readable .npy file"),
    "empty npy": ("e.npy", lambda path: path.write_bytes(b""), "e.npy: not a readable .npy file"),
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
        "e.npz: not a readable array x",
    ),
    "array of objects": (
        "e.npz",
        replaced("x", np.array([object] * N)),
        "e.npz: not a readable array x .it holds Python objects",
    ),
    "no events in npz": ("e.npz", replaced("p", None), "e.npz: its arrays are t, x, y; it must hold x, y, t and p"),
    "empty stream": (
        "e.npz",
        lambda path: np.savez(path, **{name: np.zeros(0) for name in "xytp"}),
        "the file holds no events",
    ),
    "matrix as column": ("e.npz", replaced("x", np.zeros((N, 2), int)), r"x has shape \(300, 2\)"),
    "three columns": ("e.npy", lambda path: np.save(path, np.zeros((9, 3))), "has 3 columns; column 3 must hold p"),
    "one column": ("e.npy", lambda path: np.save(path, np.zeros(9)), r"has shape \(9,\)"),
    "records without p": (
        "e.npy",
        lambda path: np.save(path, np.zeros(9, [("x", "u2"), ("y", "u2"), ("t", "i8")])),
        "have no field p",
    ),
    "words": ("e.npz", replaced("x", np.array(["one"] * N)), "column x has type <U3; store numbers"),
    "fractional pixel": ("e.npz", replaced("y", ZEROS + 0.5), "event 0 has y = 0.5; it must be a whole number"),
    "three polarities": ("e.npz", replaced("p", np.arange(N) % 3 - 1), "event 1 has p = 0; .* -1 beside it"),
    "NaN time": ("e.npz", replaced("t", np.full(N, np.nan)), "event 0 has t = nan; check the unit"),
    "unsorted": ("e.npz", replaced("t", T[::-1].copy()), "sort the events by time"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_malformed_event_files_are_one_clear_line(fault: str, tmp_path: Path) -> None:
    name, write, message = FAULTS[fault]
    assert_fault_is_one_line(tmp_path / name, write, message, open_events)
