"""Opening an event file of any format."""

from __future__ import annotations

from pathlib import Path

from aenerf_ns.dataparsers.aedat4 import Aedat4File
from aenerf_ns.dataparsers.ecd import EcdEventFile
from aenerf_ns.dataparsers.event_hdf5 import Hdf5EventFile
from aenerf_ns.dataparsers.prophesee_dat import PropheseeDatFile
from aenerf_ns.dataparsers.prophesee_header import read_header
from aenerf_ns.dataparsers.prophesee_raw import PropheseeRawFile
from aenerf_ns.dataparsers.rosbag import RosbagEventFile
from aenerf_ns.dataparsers.sensor_size import sensor_size
from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile


def open_event_file(
    path: Path, width: int | None = None, height: int | None = None, topic: str | None = None
) -> EventFile:
    """Opens an event file in the format that its first bytes tell (text: its suffix).

    Args:
        path: the file.
        width: pixel columns of the sensor; needed where the file does not tell them.
        height: pixel rows, likewise.
        topic: the topic of a bag, or the number of the stream of an AEDAT4 file, where several hold events.

    Raises:
        DataError: the file is missing or empty, its format is not known, its header cannot be read, or the size of the
            sensor is not known or not the one given.
    """
    if path.is_dir():
        raise DataError(path, "it is a folder", "name the event file in it (bags of ROS 2: convert them to ROS 1)")
    if not path.is_file():
        raise DataError(path, "there is no such event file", "check the path of the dataset")
    with path.open("rb") as file:
        beginning = file.read(16)
    if not beginning:
        raise DataError(path, "the file is empty", "record or copy it again")
    if beginning.startswith(b"#!AER-DAT"):
        return Aedat4File(path, width, height, topic)
    if beginning.startswith(b"#ROSBAG"):
        return RosbagEventFile(path, width, height, topic)
    if topic is not None:
        raise DataError(path, f"only bags and AEDAT4 files have topics, but {topic} was given", "leave it out")
    if beginning.startswith(b"% "):
        is_raw = {"evt", "format"} & set(read_header(path).fields) or path.suffix.lower() == ".raw"
        return (PropheseeRawFile if is_raw else PropheseeDatFile)(path, width, height)
    if beginning.startswith(b"\x89HDF\r\n\x1a\n"):
        return Hdf5EventFile(path, *sensor_size(path, None, width, height))
    if path.suffix.lower() == ".txt":
        return EcdEventFile(path, *sensor_size(path, None, width, height))
    raise DataError(
        path,
        f"its format is not known (it begins with {beginning[:8]!r})",
        "RAW (EVT2, EVT3), DAT, AEDAT4, bags of ROS 1, HDF5 and text are read",
    )
