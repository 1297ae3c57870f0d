"""Open an event file of any format."""

from __future__ import annotations

import re
from pathlib import Path

from aenerf_ns.errors import DataError
from aenerf_ns.files.aedat4 import Aedat4File
from aenerf_ns.files.event_arrays import open_array_events
from aenerf_ns.files.event_hdf5 import open_hdf5_events
from aenerf_ns.files.event_reader import EventFile, resolve_sensor_size
from aenerf_ns.files.event_text import TextEventFile, stated_size
from aenerf_ns.files.limits import bounded
from aenerf_ns.files.prophesee import HEADER_BYTES, PropheseeDatFile, PropheseeHeader, PropheseeRawFile
from aenerf_ns.files.rosbag import BAG_MAGIC, RosbagEventFile
from aenerf_ns.files.text import TimeUnit

SUFFIXES = (".raw", ".dat", ".aedat4", ".bag", ".db3", ".mcap", ".h5", ".hdf5", ".npz", ".npy", ".csv", ".txt")
"""The endings of names of event files."""

_FORMAT_OF_MAGIC = {
    b"#!AER-DAT": "AEDAT4",
    b"\x89HDF\r\n\x1a\n": "HDF5",
    b"% ": "Prophesee",
    **dict.fromkeys(BAG_MAGIC, "bag"),
}
_FORMAT_OF_SUFFIX = {".npz": "NumPy", ".npy": "NumPy", ".csv": "CSV", ".txt": "text"}
_COMMENTED_TABLE = re.compile(rb"(% [^\n]*\n)+[\w\s,.;+\"-]{8}")
_WITH_TOPICS = ("AEDAT4", "bag")
# Formats that may leave the unit of the times open.
_WITH_TIME_UNIT = ("HDF5", "NumPy", "CSV", "text")


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
        width, height: size of the sensor in pixels; needed where the file does not state it.
        topic: the topic of a bag, or the number of the stream of an AEDAT4 file, where several hold events.
        time_unit: of the times of HDF5, npz, npy, csv and text, where the file states none.

    Raises:
        DataError: the format is not known, or a size is not given and the file is missing or does not state it.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> import numpy as np
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "events.txt"  # seconds, x, y, polarity
        ...     np.savetxt(path, [[0.001, 3, 4, 1], [0.002, 5, 6, 0]], fmt="%.3f %d %d %d")
        ...     for events in open_event_file(path, width=8, height=8).chunks():
        ...         print(events.x, events.y, events.t, events.p)
        [3 5] [4 6] [1000000 2000000] [ 1 -1]
    """
    with bounded(path, "event file"):
        if not path.exists() and width is not None and height is not None:
            # A missing file has any format: every method says that there is no such file.
            return TextEventFile(path, width, height)
        beginning = _read_beginning(path)
    name = _format(path, beginning)
    if time_unit is not None and name not in _WITH_TIME_UNIT:
        raise DataError(path, f"its format has a time unit, but {time_unit} was given", "leave it out")
    if topic is not None and name not in _WITH_TOPICS:
        raise DataError(path, f"only bags and AEDAT4 files have topics, but {topic} was given", "leave it out")
    with bounded(path, f"{name} file"):
        if name == "AEDAT4":
            return Aedat4File(path, width, height, topic)
        if name == "bag":
            return RosbagEventFile(path, width, height, topic)
        if name == "Prophesee":
            header = PropheseeHeader.parse(path, beginning)
            # Only headers of RAW files name an encoding.
            is_raw = path.suffix.lower() == ".raw" or not header.fields.keys().isdisjoint(("evt", "format"))
            return (PropheseeRawFile if is_raw else PropheseeDatFile)(path, header, width, height)
        if name == "HDF5":
            return open_hdf5_events(path, width, height, time_unit)
        size = resolve_sensor_size(path, None if name == "NumPy" else stated_size(beginning), width, height)
        return (open_array_events if name == "NumPy" else TextEventFile)(path, *size, time_unit)


def _read_beginning(path: Path) -> bytes:
    """Read the first bytes of a file, those of a whole header; none of the folder of a bag."""
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return b""
        remedy = "name the event file in it, or ros2 bag reindex it"
        raise DataError(path, "it is a folder without the metadata.yaml of a bag of ROS 2", remedy)
    with path.open("rb") as file:
        beginning = file.read(HEADER_BYTES)
    if not beginning:
        raise DataError(path, "the file is empty", "record or copy it again")
    return beginning


def _format(path: Path, beginning: bytes) -> str:
    if not beginning:
        return "bag"
    by_suffix = _FORMAT_OF_SUFFIX.get(path.suffix.lower())
    for magic, name in _FORMAT_OF_MAGIC.items():
        # Comments of Metavision's CSV begin like the header of its RAW files.
        is_table = by_suffix in ("CSV", "text") and _COMMENTED_TABLE.match(beginning)
        if beginning.startswith(magic) and not is_table:
            return name
    # The first bytes of other files do not tell what they are.
    if by_suffix is None:
        remedy = "RAW (EVT2, EVT3), DAT, AEDAT4, bags of ROS, HDF5, npz, npy, csv and text are read, unpacked"
        raise DataError(path, f"its format is not known (it begins with {beginning[:8]!r})", remedy)
    return by_suffix
