"""AEDAT4 files of iniVation's DV software.

https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-4.0.html

A file holds a header that describes the streams, compressed packets, and a table of the packets. Header, packets and
table are FlatBuffers (https://flatbuffers.dev/internals/). Only the few parts of FlatBuffers in use are read here.

This reader decodes 8 (a short real recording) to 20 million events/s on one core. The vendor's dv-processing (Apache
2.0, 57 MB) and the package aedat (MIT) are up to four times as fast, but of 24 damaged copies of a recording
dv-processing hung on two and aedat panicked on three.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NoReturn
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError, reading
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.files.limits import require_unpacked_size
from aenerf_ns.files.sensor_size import sensor_size
from aenerf_ns.files.unpacking import MAX_PIECE, require_unpacker, unpacked

_CHUNK = 1 << 20
_MAGIC = b"#!AER-DAT4.0\r\n"
# Microseconds.
_EVENT = np.dtype([("time", "<i8"), ("x", "<u2"), ("y", "<u2"), ("on", "u1"), ("padding", "V3")])
# DV writes headers of some kilobytes.
_MAX_HEADER = 1 << 20
# A table has some 50 bytes for a packet, and an hour of recording some 100,000 packets.
_MAX_TABLE = 1 << 25
_MAX_MICROSECONDS = np.iinfo(np.int64).max // 1000
_COMPRESSIONS = ("none", "lz4", "lz4", "zstd", "zstd")
# Indices of the fields in their tables.
_HEADER_COMPRESSION, _HEADER_TABLE_POSITION, _HEADER_INFO = range(3)
_ROW_STREAM, _ROW_COUNT = 1, 2


@dataclass(frozen=True)
class _Header:
    """The header of a file.

    Attributes:
        begin: position of the first packet in bytes.
        end: position of the end of the packets.
        table: position of the table of the packets, or None without a table.
        compression: name of the compression of the packets.
        stream: number of the stream of events.
        size: width and height of the sensor, or None where the header does not tell them.
    """

    begin: int
    end: int
    table: int | None
    compression: str
    stream: int
    size: tuple[int, int] | None


class Aedat4File(EventFile):
    """Read the events of one stream of an AEDAT4 file.

    Args:
        path: the file.
        width: pixel columns of the sensor; needed where the file does not tell them. With both sizes given, the file
            is not opened before its events are asked for.
        height: pixel rows of the sensor; needed where the file does not tell them.
        stream: number of the stream, or None when only one holds events.

    Raises:
        DataError: a size is not given, and the file is missing or its header does not tell it.
    """

    def __init__(
        self, path: Path, width: int | None = None, height: int | None = None, stream: str | None = None
    ) -> None:
        self.path = path
        self._chosen = stream
        if width is None or height is None:
            width, height = sensor_size(path, self._read_header().size, width, height)
        super().__init__(path, width, height)

    def _fail(self, problem: str) -> NoReturn:
        raise DataError(self.path, problem, "copy it again, or export it again with DV")

    def _read_header(self) -> _Header:
        self.require()
        file_size = self.path.stat().st_size
        with reading(self.path), self.path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise DataError(self.path, "it does not begin as an AEDAT4 file does", "convert older ones with DV")
            length = int.from_bytes(file.read(4), "little")
            begin = file.tell() + length
            if begin > file_size:
                self._fail("it ends within its header")
            if length > _MAX_HEADER:
                self._fail(f"its header has {length:,} bytes")
            data = file.read(length)
        try:
            root = _root(data, 0)
            compression = _number(data, root, _HEADER_COMPRESSION, "<i", 0)
            table = _number(data, root, _HEADER_TABLE_POSITION, "<q", -1)
            streams = _event_streams(data, root)
        except (struct.error, ValueError, ElementTree.ParseError) as error:
            self._fail(f"its header cannot be read ({error})")
        if not 0 <= compression < len(_COMPRESSIONS):
            self._fail(f"its compression is number {compression}")
        if table > file_size:
            self._fail(f"it ends before its table of packets at byte {table}")
        stream = self._chosen
        if stream is None and len(streams) == 1:
            stream = next(iter(streams))
        if stream not in streams:
            problem = "several streams hold events" if stream is None else f"stream {stream} holds no events"
            if not streams:
                raise DataError(self.path, "no stream holds events", "record the events too")
            raise DataError(self.path, problem, f"choose one of {', '.join(streams)}")
        # A recording that was interrupted has no table.
        place = table if table > 0 else None
        return _Header(begin, place or file_size, place, _COMPRESSIONS[compression], int(stream), streams[stream])

    def _checked_header(self) -> _Header:
        header = self._read_header()
        sensor_size(self.path, header.size, self.width, self.height)
        return header

    def _decompressor(self, compression: str) -> Callable[[bytes], bytes]:
        """Return a function that decompresses a packet or raises a DataError."""
        if compression == "none":
            return bytes
        try:
            require_unpacker(compression)
        except ImportError as error:
            raise DataError(
                self.path,
                f"its packets are compressed ({compression}), and the package for it is missing ({error})",
                "pip install 'aenerf-ns[aedat4]'",
            ) from None

        def checked(data: bytes) -> bytes:
            try:
                return unpacked(data, compression)
            except ValueError as error:
                self._fail(f"a packet cannot be read: {error}")

        return checked

    def _packets(self, file: BinaryIO, header: _Header) -> Iterator[tuple[int, int]]:
        """Yield the position and the size in bytes of each packet of the stream."""
        position = header.begin
        while position < header.end:
            file.seek(position)
            head = file.read(8)
            stream, length = struct.unpack("<2i", head) if len(head) == 8 else (0, -1)
            # No packet is empty, because its content names its kind. A file of zeros would have no end.
            if not 0 < length <= MAX_PIECE or position + 8 + length > header.end:
                self._fail(f"it ends within the packet at byte {position}, or is damaged there")
            if stream == header.stream:
                yield position + 8, length
            position += 8 + length

    def _event_packets(self, backwards: bool = False) -> Iterator[NDArray]:
        """Yield the (N,) events of each packet that has any."""
        header = self._checked_header()
        decompress = self._decompressor(header.compression)
        with reading(self.path), self.path.open("rb") as file:
            packets: Iterable[tuple[int, int]] = self._packets(file, header)
            size, total = self.path.stat().st_size, 0
            for position, length in reversed(list(packets)) if backwards else packets:
                file.seek(position)
                data = decompress(file.read(length))
                total += len(data)
                require_unpacked_size(self.path, "the stream", total, size)
                try:
                    if data[8:12] != b"EVTS":
                        raise ValueError("it does not hold events")
                    begin, count = _vector(data, _root(data, 4), 0)
                    if count:
                        yield np.frombuffer(data, _EVENT, count, begin)
                except (struct.error, ValueError) as error:
                    self._fail(f"the packet at byte {position} cannot be read ({error})")

    def read_chunks(self) -> Iterator[EventStream]:
        waiting: list[NDArray] = []
        count = 0
        for events in self._event_packets():
            waiting.append(events)
            count += len(events)
            if count >= _CHUNK:
                yield self._stream_of(np.concatenate(waiting))
                waiting, count = [], 0
        if waiting:
            yield self._stream_of(np.concatenate(waiting))

    def _stream_of(self, events: NDArray) -> EventStream:
        return EventStream(
            events["x"].astype(np.uint16),
            events["y"].astype(np.uint16),
            self._nanoseconds(events["time"]),
            np.where(events["on"], 1, -1).astype(np.int8),
            self.width,
            self.height,
            self.path,
        )

    def _nanoseconds(self, time: NDArray) -> NDArray[np.int64]:
        if (np.abs(time) > _MAX_MICROSECONDS).any() or (time == np.iinfo(np.int64).min).any():
            self._fail("an event has a time of more than 292 years")
        return time * 1000

    def time_span(self) -> tuple[int, int]:
        first, last = (next(self._event_packets(backwards), None) for backwards in (False, True))
        if first is None or last is None:
            raise self.empty_error()
        start, end = self._nanoseconds(np.array([first["time"][0], last["time"][-1]])).tolist()
        return start, end

    def count(self) -> int | None:
        """Return the number of events from the table of packets. An interrupted recording has no table, and a table of
        more than 32 MB is not read."""
        header = self._checked_header()
        if header.table is None or self.path.stat().st_size - header.table > _MAX_TABLE:
            return None
        with reading(self.path), self.path.open("rb") as file:
            file.seek(header.table)
            data = self._decompressor(header.compression)(file.read())
        try:
            begin, rows = _vector(data, _root(data, 4), 0)
            if 4 * rows > len(data):
                raise ValueError(f"it has {rows} rows")
            total = 0
            for place in range(begin, begin + 4 * rows, 4):
                row = place + struct.unpack_from("<I", data, place)[0]
                if _number(data, row, _ROW_STREAM, "<i", -1) == header.stream:
                    total += _number(data, row, _ROW_COUNT, "<q", 0)
            if total < 0:
                raise ValueError(f"it counts {total} events")
            require_unpacked_size(self.path, "its events", total * _EVENT.itemsize, self.path.stat().st_size)
            return total
        except DataError:
            raise
        except (struct.error, ValueError) as error:
            self._fail(f"its table of packets cannot be read ({error})")


def _event_streams(header: bytes, root: int) -> dict[str, tuple[int, int] | None]:
    """Return the size of the sensor of each stream of events, by the number of the stream."""
    begin, length = _vector(header, root, _HEADER_INFO)
    tree = ElementTree.fromstring(header[begin : begin + length].decode("utf-8"))
    streams: dict[str, tuple[int, int] | None] = {}
    for node in tree.iterfind("node[@name='outInfo']/node"):
        attributes = {item.get("key"): item.text or "" for item in node.iter("attr")}
        if attributes.get("typeIdentifier") == "EVTS":
            sizes = [attributes.get(key, "") for key in ("sizeX", "sizeY")]
            streams[str(int(node.get("name", "")))] = (int(sizes[0]), int(sizes[1])) if all(sizes) else None
    return streams


# A FlatBuffer's table begins with the distance to the list of its fields' places. Every read is checked by `struct`.


def _root(data: bytes, begin: int) -> int:
    """Return the position of the table that a buffer holds."""
    return begin + _unpack("<I", data, begin)


def _field(data: bytes, table: int, index: int) -> int | None:
    """Return the position of a field of a table, or None when the field has its default."""
    fields = table - _unpack("<i", data, table)
    if 4 + 2 * index >= _unpack("<H", data, fields):
        return None
    distance = _unpack("<H", data, fields + 4 + 2 * index)
    return table + distance if distance else None


def _number(data: bytes, table: int, index: int, kind: str, default: int) -> int:
    place = _field(data, table, index)
    return default if place is None else _unpack(kind, data, place)


def _vector(data: bytes, table: int, index: int) -> tuple[int, int]:
    """Return the position of the first item of a vector, and the number of items."""
    place = _field(data, table, index)
    if place is None:
        return 0, 0
    begin = place + _unpack("<I", data, place)
    return begin + 4, _unpack("<I", data, begin)


def _unpack(kind: str, data: bytes, place: int) -> int:
    if place < 0:
        raise ValueError("an offset leads out of it")
    return struct.unpack_from(kind, data, place)[0]
