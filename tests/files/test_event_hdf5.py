"""Events in HDF5: the native file and those of other projects."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.event_table_writers import HEIGHT, WIDTH, made_columns, signed, write_prophesee

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_hdf5 import Hdf5EventFile, Hdf5EventWriter, open_hdf5_events
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.files.open import open_event_file


def open_events(path: Path) -> EventFile:
    return open_hdf5_events(path, WIDTH, HEIGHT)


def test_native_file_is_recognized(tmp_path: Path) -> None:
    columns = signed(made_columns())
    with Hdf5EventWriter(tmp_path / "events.h5") as writer:
        writer.append(EventStream(**columns, width=WIDTH, height=HEIGHT))
    events = open_events(tmp_path / "events.h5")
    # Its attribute states nanoseconds. Without it whole times are microseconds, whatever the types.
    assert events.time_span()[0] == columns["t"][0]
    assert events.assumed_unit() is None
    assert open_hdf5_events(events.path, WIDTH, HEIGHT, "ns").assumed_unit() is None
    with h5py.File(tmp_path / "events.h5", "a") as file:
        del file["events"].attrs["time_unit"]
    assert open_events(tmp_path / "events.h5").time_span()[0] == columns["t"][0] * 1_000
    assert open_events(tmp_path / "events.h5").assumed_unit() == "us"
    # In a dataset folder they are nanoseconds.
    assert Hdf5EventFile(tmp_path / "events.h5", WIDTH, HEIGHT).time_span()[0] == columns["t"][0]


# Some writers store a string as an array.
@pytest.mark.parametrize(("dtype", "offset", "unit"), [(np.int8, 10, "ms"), (np.uint8, 10.0, np.array([b"ms"]))])
def test_stated_unit_and_offset_count_whatever_the_types(
    dtype: type, offset: float, unit: object, tmp_path: Path
) -> None:
    with h5py.File(tmp_path / "events.h5", "w") as file:
        for name in "xytp":
            file[f"events/{name}"] = np.array([5, 7] if name == "t" else [1, 1], dtype)
        file["events"].attrs.update(time_unit=unit, time_offset=offset)
    assert open_events(tmp_path / "events.h5").time_span() == (15_000_000, 17_000_000)


def test_refuse_a_unit_where_one_is_known(tmp_path: Path) -> None:
    with Hdf5EventWriter(tmp_path / "events.h5"):
        pass
    with pytest.raises(DataError, match="it states its time unit, 'ns', but us was given"):
        open_hdf5_events(tmp_path / "events.h5", WIDTH, HEIGHT, "us").time_span()
    (tmp_path / "events.raw").write_text("% evt 2.0\n")
    with pytest.raises(DataError, match="its format has a time unit, but us was given"):
        open_event_file(tmp_path / "events.raw", WIDTH, HEIGHT, time_unit="us")


@pytest.mark.parametrize("geometry", [f"{WIDTH}x{HEIGHT}", np.bytes_(f"{WIDTH}x{HEIGHT}")])
def test_metavision_states_the_size(geometry: str | bytes, tmp_path: Path) -> None:
    write_prophesee(tmp_path / "events.h5", made_columns())
    with pytest.raises(DataError, match="does not state the size of its sensor"):
        open_event_file(tmp_path / "events.h5")
    with h5py.File(tmp_path / "events.h5", "a") as file:
        file.attrs["geometry"] = geometry
    events = open_event_file(tmp_path / "events.h5")
    assert (events.width, events.height) == (WIDTH, HEIGHT)
    with pytest.raises(DataError, match="its sensor has 60 x 40 pixels, but 346 x 260 were given"):
        open_event_file(tmp_path / "events.h5", 346, 260)
