"""Open an event file of any format."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from aenerf_ns.errors import DataError, reading
from aenerf_ns.events.stream import EventFile, EventStream, require_event_file
from aenerf_ns.files.aedat4 import Aedat4File
from aenerf_ns.files.event_arrays import open_array_events
from aenerf_ns.files.event_hdf5 import open_hdf5_events
from aenerf_ns.files.event_text import CsvEventFile, TextEventFile
from aenerf_ns.files.prophesee_dat import PropheseeDatFile
from aenerf_ns.files.prophesee_header import read_header
from aenerf_ns.files.prophesee_raw import PropheseeRawFile
from aenerf_ns.files.rosbag import RosbagEventFile
from aenerf_ns.files.sensor_size import sensor_size
from aenerf_ns.files.text import TimeUnit

_FORMAT_OF_SUFFIX = {
    ".raw": "raw",
    ".dat": "dat",
    ".aedat4": "aedat4",
    ".bag": "bag",
    ".db3": "bag",
    ".mcap": "bag",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".npz": "arrays",
    ".npy": "arrays",
    ".csv": "csv",
    ".txt": "text",
}
# ROS 1, and the two storages of ROS 2.
_BAG_MAGIC = (b"#ROSBAG", b"SQLite format 3\0", b"\x89MCAP0\r\n")
_WITHOUT_MAGIC = ("arrays", "csv", "text")

SUFFIXES = tuple(_FORMAT_OF_SUFFIX)
"""The endings of names of event files."""


def open_event_file(
    path: Path,
    width: int | None = None,
    height: int | None = None,
    topic: str | None = None,
    time_unit: TimeUnit | None = None,
) -> EventFile:
    """Open an event file. Its first bytes tell the format; for NumPy's files, CSV and text its suffix does.

    With both sizes given, a missing file is an error only when its events are asked for: a trained run opens without
    its events.

    Args:
        path: the file, or the folder of a bag of ROS 2.
        width: pixel columns of the sensor; needed where the file does not tell them.
        height: pixel rows of the sensor; needed where the file does not tell them.
        topic: the topic of a bag, or the number of the stream of an AEDAT4 file, where several hold events.
        time_unit: of the times of HDF5, npz, npy and csv, where the file states none.

    Raises:
        DataError: the format is not known, or a size is not given and the file is missing or does not tell it.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> import numpy as np
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "events.txt"  # seconds, x, y, polarity
        ...     np.savetxt(path, [[0.001, 3, 4, 1], [0.002, 5, 6, 0]], fmt="%.3f %d %d %d")
        ...     for events in open_event_file(path, width=8, height=8).read_chunks():
        ...         print(events.x, events.y, events.t, events.p)
        [3 5] [4 6] [1000000 2000000] [ 1 -1]
    """
    if not path.exists() and width is not None and height is not None:
        return _MissingEventFile(path, width, height)
    name = _format(path)
    if time_unit is not None and name not in ("hdf5", "arrays", "csv"):
        raise DataError(path, f"its format has a time unit, but {time_unit} was given", "leave it out")
    if name == "aedat4":
        return Aedat4File(path, width, height, topic)
    if name == "bag":
        return RosbagEventFile(path, width, height, topic)
    if topic is not None:
        raise DataError(path, f"only bags and AEDAT4 files have topics, but {topic} was given", "leave it out")
    if name == "raw":
        return PropheseeRawFile(path, width, height)
    if name == "dat":
        return PropheseeDatFile(path, width, height)
    size = sensor_size(path, None, width, height)
    if name == "hdf5":
        return open_hdf5_events(path, *size, time_unit)
    if name == "arrays":
        return open_array_events(path, *size, time_unit)
    return CsvEventFile(path, *size, time_unit) if name == "csv" else TextEventFile(path, *size)


class _MissingEventFile(EventFile):
    def read_chunks(self) -> Iterator[EventStream]:
        self.require()
        raise AssertionError("the file appeared while it was open")

    def time_span(self) -> tuple[int, int]:
        self.require()
        raise AssertionError("the file appeared while it was open")


def _format(path: Path) -> str:
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return "bag"
        raise DataError(path, "it is a folder without the metadata.yaml of a bag of ROS 2", "name the event file in it")
    require_event_file(path)
    suffix = path.suffix.lower()
    with reading(path), path.open("rb") as file:
        beginning = file.read(16)
    if not beginning:
        raise DataError(path, "the file is empty", "record or copy it again")
    if beginning.startswith(b"#!AER-DAT"):
        return "aedat4"
    if beginning.startswith(_BAG_MAGIC):
        return "bag"
    if beginning.startswith(b"\x89HDF\r\n\x1a\n"):
        return "hdf5"
    if beginning.startswith(b"% "):
        is_raw = suffix == ".raw" or {"evt", "format"} & set(read_header(path).fields)
        return "raw" if is_raw else "dat"
    # A binary format would have been recognised.
    by_suffix = _FORMAT_OF_SUFFIX.get(suffix)
    if by_suffix in _WITHOUT_MAGIC:
        return by_suffix
    raise DataError(
        path,
        f"its format is not known (it begins with {beginning[:8]!r})",
        "RAW (EVT2, EVT3), DAT, AEDAT4, bags of ROS, HDF5, npz, npy, csv and text are read",
    )
