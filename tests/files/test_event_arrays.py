"""Events in NumPy's files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.event_table_writers import (
    HEIGHT,
    WIDTH,
    Columns,
    N,
    lengths_of_read_pieces,
    made_columns,
    records,
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
