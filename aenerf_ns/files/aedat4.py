"""AEDAT4 files of iniVation's DV software.

https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-4.0.html

A file holds a header that describes the streams, compressed packets, and a table of the packets. The table is not read.
Header and packets are FlatBuffers (https://flatbuffers.dev/internals/). Only the parts that are used are read.

Other readers were tried and are not used: of damaged copies, dv-processing hung on some, and faery and aedat panicked.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import BinaryIO, NoReturn
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_reader import TOPIC_OPTION, EventFile, batches, resolve_sensor_size
from aenerf_ns.files.limits import MAX_HEADER, MAX_PIECE, require_unpacked_size

_MAGIC = b"#!AER-DAT4.0\r\n"
# Microseconds.
_EVENT = np.dtype([("time", "<i8"), ("x", "<u2"), ("y", "<u2"), ("on", "u1"), ("padding", "V3")])
_MAX_MICROSECONDS = np.iinfo(np.int64).max // 1000
# The module that unpacks what is compressed in a way, by its number; 0 is not compressed.
_COMPRESSIONS = ("", "lz4.frame", "lz4.frame", "backports.zstd", "backports.zstd")
# Indices of the fields in their tables.
_HEADER_COMPRESSION, _HEADER_TABLE_POSITION, _HEADER_INFO = range(3)


class Aedat4File(EventFile):
    """Read the events of one stream of an AEDAT4 file.

    Args:
        path: the file.
        width, height: size of the sensor in pixels; needed where the file does not state it.
        stream: number of the stream, or None when only one holds events.

    Raises:
        DataError: the header is malformed or has no such stream, or a size is not known.
    """

    kind = "AEDAT4 file"
    extra = "aedat4"

    def __init__(self, path: Path, width: int | None, height: int | None, stream: str | None) -> None:
        self.path = path
        self._file_size = path.stat().st_size
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise DataError(path, "it does not begin as an AEDAT4 file does", "convert older ones with DV")
            length = int.from_bytes(file.read(4), "little")
            if length > MAX_HEADER:
                self._fail(f"its header has {length:,} bytes")
            header = _Table(file.read(length), 0)
            self._begin = file.tell()
        compression = header.number(_HEADER_COMPRESSION, "<i", 0)
        if not 0 <= compression < len(_COMPRESSIONS):
            self._fail(f"its compression is number {compression}")
        self._compression = _COMPRESSIONS[compression]
        # A recording that was interrupted has no table.
        table = header.number(_HEADER_TABLE_POSITION, "<q", -1)
        self._table = table if table > 0 else None
        self._end = self._table or self._file_size
        if self._end > self._file_size:
            self._fail(f"it ends before its table of packets at byte {table}")
        streams = _event_streams(header)
        if not streams:
            raise DataError(path, "no stream holds events", "record the events too")
        if stream is None and len(streams) == 1:
            stream = next(iter(streams))
        if stream not in streams:
            problem = "several streams hold events" if stream is None else f"stream {stream} holds no events"
            raise DataError(path, problem, f"choose one of {', '.join(streams)}: {TOPIC_OPTION}")
        self._number = int(stream)
        super().__init__(path, *resolve_sensor_size(path, streams[stream], width, height))

    def _fail(self, problem: str) -> NoReturn:
        raise DataError(self.path, problem, "copy it again, or export it again with DV")

    def _unpack(self, data: bytes) -> bytes:
        return import_module(self._compression).decompress(data) if self._compression else data

    def _packets(self, file: BinaryIO) -> Iterator[tuple[int, int]]:
        """Yield the position and the size in bytes of each packet of the stream."""
        position = self._begin
        while position < self._end:
            file.seek(position)
            head = file.read(8)
            stream, length = struct.unpack("<2i", head) if len(head) == 8 else (0, MAX_PIECE)
            is_cut = position + 8 + length > self._end
            # No packet is empty, because its content names its kind. A file of zeros would have no end.
            if not 0 < length <= MAX_PIECE or (is_cut and self._table is not None):
                self._fail(f"the packet at byte {position} is damaged")
            if is_cut:
                self._leave_out_end("a packet", position)
                return
            if stream == self._number:
                yield position + 8, length
            position += 8 + length

    def _event_packets(self, backwards: bool = False) -> Iterator[NDArray]:
        """Yield the (N,) events of each packet that has any."""
        total = 0
        with self.path.open("rb") as file:
            packets = self._packets(file)
            for position, length in reversed(list(packets)) if backwards else packets:
                file.seek(position)
                data = self._unpack(file.read(length))
                total += len(data)
                require_unpacked_size(self.path, "the stream", total, self._file_size)
                if data[8:12] != b"EVTS":
                    self._fail(f"the packet at byte {position} does not hold events")
                begin, count = _Table(data, 4).vector(0)
                if count:
                    yield np.frombuffer(data, _EVENT, count, begin)

    def read_chunks(self) -> Iterator[EventStream]:
        for events in batches(self._event_packets()):
            x, y = (events[name].astype(np.uint16) for name in "xy")
            polarity = np.where(events["on"], 1, -1).astype(np.int8)
            yield self._stream((x, y, self._nanoseconds(events["time"]), polarity))

    def _nanoseconds(self, time: NDArray) -> NDArray[np.int64]:
        if not ((time >= -_MAX_MICROSECONDS) & (time <= _MAX_MICROSECONDS)).all():
            self._fail("an event has a time of more than 292 years")
        return time * 1000

    def read_time_span(self) -> tuple[int, int] | None:
        first, last = (next(self._event_packets(backwards), None) for backwards in (False, True))
        if first is None or last is None:
            return None
        start, end = self._nanoseconds(np.array([first["time"][0], last["time"][-1]])).tolist()
        return start, end


def _event_streams(header: _Table) -> dict[str, tuple[int, int] | None]:
    """Return the size of the sensor of each stream of events, by the number of the stream."""
    begin, length = header.vector(_HEADER_INFO)
    tree = ElementTree.fromstring(header.data[begin : begin + length].decode("utf-8"))
    streams: dict[str, tuple[int, int] | None] = {}
    for node in tree.iterfind("node[@name='outInfo']/node"):
        attributes = {item.get("key"): item.text or "" for item in node.iter("attr")}
        if attributes.get("typeIdentifier") == "EVTS":
            sizes = [attributes.get(key, "") for key in ("sizeX", "sizeY")]
            streams[str(int(node.get("name", "")))] = (int(sizes[0]), int(sizes[1])) if all(sizes) else None
    return streams


class _Table:
    """A table of a FlatBuffer: at ``begin`` is the distance to it, and it begins with that to the list of its fields.

    Raises:
        struct.error: a position lies outside the buffer, here and in the methods.
    """

    def __init__(self, data: bytes, begin: int) -> None:
        self.data = data
        self._position = begin + self._unpack("<I", begin)

    def _unpack(self, kind: str, position: int) -> int:
        if position < 0:
            raise struct.error("an offset leads out of a table")
        return struct.unpack_from(kind, self.data, position)[0]

    def _field(self, index: int) -> int | None:
        """Return the position of a field, or None when it has its default."""
        fields = self._position - self._unpack("<i", self._position)
        if 4 + 2 * index >= self._unpack("<H", fields):
            return None
        distance = self._unpack("<H", fields + 4 + 2 * index)
        return self._position + distance if distance else None

    def number(self, index: int, kind: str, default: int) -> int:
        """Return the number in a field, of a type of the module struct."""
        position = self._field(index)
        return default if position is None else self._unpack(kind, position)

    def vector(self, index: int) -> tuple[int, int]:
        """Return the position of the first item of a vector, and the number of its items."""
        position = self._field(index)
        if position is None:
            return 0, 0
        begin = position + self._unpack("<I", position)
        return begin + 4, self._unpack("<I", begin)
