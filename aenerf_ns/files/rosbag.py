"""Events in bags of ROS 1 and ROS 2: arrays of events, and packets of encoded events.

* ``dvs_msgs/EventArray``, and those of ``dv_ros_msgs`` and ``prophesee_event_msgs`` with the same fields:
  https://github.com/uzh-rpg/rpg_dvs_ros/tree/master/dvs_msgs/msg
* ``event_camera_msgs/EventPacket``, formerly ``event_array_msgs/EventArray``: https://github.com/ros-event-camera/event_camera_msgs

The package rosbags reads the bags. The messages are taken apart here, because rosbags makes a Python object of each
event. Its AnyReader is not used: it refuses bags whose definitions of other messages are missing or do not match.
"""

from __future__ import annotations

import re
import shlex
import struct
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, groupby, islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_reader import TOPIC_OPTION, Columns, EventFile, batches, resolve_sensor_size
from aenerf_ns.files.limits import MAX_HEADER, bounded, require_unpacked_size, size_on_disk
from aenerf_ns.files.plain_yaml import read_plain_yaml

if TYPE_CHECKING:
    from rosbags import rosbag1, rosbag2

_ROS1_MAGIC = b"#ROSBAG"
BAG_MAGIC = (_ROS1_MAGIC, b"SQLite format 3\0", b"\x89MCAP0\r\n")
"""The beginnings of bags: of ROS 1, and of the two storages of ROS 2."""
_ROS1_HEADER_BYTES = 4096
_MCAP_MAGIC, _MCAP_FOOTER = BAG_MAGIC[2], 0x02

# The second is its former name.
_PACKET_TYPES = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
_ARRAY_TYPES = tuple(f"{name}/msg/EventArray" for name in ("dvs_msgs", "dv_ros_msgs", "prophesee_event_msgs"))
# ROS 1 serializes an event without padding. ROS 2 aligns each number to its size; see `_aligned_events`.
_PIXEL = [("x", "<u2"), ("y", "<u2")]
_TIME_AND_POLARITY = [("seconds", "<u4"), ("nanoseconds", "<u4"), ("polarity", "?")]
_PACKED_EVENT = np.dtype([*_PIXEL, *_TIME_AND_POLARITY])
_ALIGNED_EVENT = np.dtype([*_PIXEL, ("", "V2"), *_TIME_AND_POLARITY, ("", "V1")])
# CDR, little-endian: the serialization of ROS 2.
_CDR_HEADER = b"\0\1"
_CDR_HEADER_BYTES = 4
# Some middleware pads messages of ROS 2 to a multiple of this number of bytes.
_CDR_PADDING = 4
_WORD = np.dtype("<u2")
# Nanoseconds after which the 24 bits of a time in EVT 3.0 come again.
_LAP = (1 << 24) * 1000
# Packets from which the clocks' difference is taken, about 0.4 s.
_CLOCK_PACKETS = 100
# Nanoseconds by which the stamp of a packet may be late.
_MAX_DELAY = 1_000_000_000
# Seconds before the end of a bag in which its last event is looked for.
_TAIL_SECONDS = (1, 10, 100)


@dataclass(frozen=True)
class _Message:
    """A message of either type, with its time in nanoseconds.

    The number (``sequence``) and the encoding are those of a packet. The content is the events of an array, or the
    bytes of a packet.
    """

    stamp: int
    width: int
    height: int
    sequence: int | None
    encoding: str
    content: NDArray


class RosbagEventFile(EventFile):
    """Read the events of one topic of a bag, at the times of ROS.

    An EventPacket has the times of the camera's own clock. One offset brings them all to the clock of ROS: the smallest
    difference between the stamp of a packet and its first time, among the first hundred packets. The offset is late by
    the delay of the fastest of these packets, typically below a millisecond.

    Args:
        path: a bag of ROS 1; or of ROS 2, as a folder with metadata.yaml or as a single .db3 or .mcap file.
        width, height: size of the sensor in pixels; by default the messages tell it. With both given, the bag is not
            opened before its events are asked for.
        topic: the topic, or None when only one holds events.

    Raises:
        DataError: a size is not given, and the bag is missing, cannot be read or holds no such topic, or the package
            rosbags is missing.
    """

    extra = "rosbag"

    def __init__(self, path: Path, width: int | None, height: int | None, topic: str | None) -> None:
        self.path = path
        self._topic, self._size = topic, (width, height)
        self._is_ros2 = path.is_dir() or not _begins(path, _ROS1_MAGIC)
        self.kind = f"bag of ROS {2 if self._is_ros2 else 1}"
        if None in self._size:
            with bounded(path, self.kind, self.extra):
                if next(self._messages(), None) is None:
                    raise self.empty_error()
        super().__init__(path, *resolve_sensor_size(path, None, *self._size))

    @contextmanager
    def _open(self) -> Iterator[rosbag1.Reader | rosbag2.Reader]:
        import rosbags.rosbag1 as rosbag1
        import rosbags.rosbag2 as rosbag2

        is_mcap = self.path.is_file() and _begins(self.path, _MCAP_MAGIC)
        if self.path.is_dir():
            _require_distinct_files(self.path / "metadata.yaml")
        elif self._is_ros2:
            _require_whole_bag(self.path)
            if is_mcap:
                _require_records(self.path)
        else:
            with self.path.open("rb") as file:
                if b"index_pos=" + bytes(8) in file.read(_ROS1_HEADER_BYTES):
                    problem = "it has no index, as if interrupted"
                    raise DataError(self.path, problem, f"rosbag reindex {shlex.quote(str(self.path))}")
        try:
            with rosbag2.Reader(self.path) if self._is_ros2 else rosbag1.Reader(self.path) as reader:
                yield reader
        except (rosbag1.ReaderError, rosbag2.ReaderError) as error:
            if self._is_ros2 and not is_mcap:
                raise
            # A recording that was interrupted lacks its end.
            repair = "mcap recover" if is_mcap else "rosbag reindex"
            problem = f"not a readable {self.kind} ({error})"
            raise DataError(self.path, problem, f"copy it again, or repair one that was cut off ({repair})") from error

    def _messages(self, start: int | None = None) -> Iterator[_Message]:
        """Yield the messages of the topic in the order in which they were received, from a time in nanoseconds on."""
        packed, total = size_on_disk(self.path), 0
        with self._open() as bag:
            types = {connection.topic: connection.msgtype for connection in bag.connections}
            topic = _choose(self.path, types, self._topic)
            chosen = [connection for connection in bag.connections if connection.topic == topic]
            for connection, _, data in bag.messages(chosen, start=start):
                total += len(data)
                require_unpacked_size(self.path, f"the topic {topic}", total, packed)
                try:
                    message = _parse(data, connection.msgtype in _PACKET_TYPES, self._is_ros2)
                except struct.error:
                    problem = f"a message of {topic} does not have the parts of its type"
                    raise DataError(self.path, problem, "copy it again") from None
                # Zeros are what a message has that states no size.
                stated = (message.width, message.height) if message.width or message.height else None
                self._size = resolve_sensor_size(self.path, stated, *self._size)
                yield message

    def _columns(self, start: int | None = None) -> Iterator[Columns]:
        """Yield columns of the messages received from a time in nanoseconds on."""
        first = next(self._messages(), None)
        if first is not None and first.sequence is not None:
            yield from self._columns_of_packets(start)
        elif first is not None:
            for events in batches(message.content for message in self._messages(start)):
                x, y = (events[name].astype(np.uint16) for name in "xy")
                t = events["seconds"].astype(np.int64) * 1_000_000_000 + events["nanoseconds"]
                yield x, y, t, np.where(events["polarity"], 1, -1).astype(np.int8)

    def _columns_of_packets(self, start: int | None) -> Iterator[Columns]:
        # Imported lazily: every command of every method imports this module, and numba is slow to import.
        from aenerf_ns.files.evt_words import EVT3, decode_words, initial_state, without_damaged_times

        # The decoder's state is of no use at the first packet and after lost packets, where the sequence jumps.
        numbered = enumerate(self._messages(start))
        before = None
        for ahead, run in groupby(numbered, lambda pair: (pair[1].sequence or 0) - pair[0]):
            messages = (message for _, message in run)
            first = next(messages)
            if before is not None and ahead > before and start is None:
                self.left_out.add_missing("packets that were lost when it was recorded", ahead - before)
            before = ahead
            words_of_packets = map(self._words, chain([first], messages))
            blocks = without_damaged_times(words_of_packets, EVT3, self.left_out)
            for words in blocks:
                time = _first_time(words)
                if time is not None:
                    laps = round((first.stamp - self._clock_offset - time) / _LAP)
                    state = initial_state(self._clock_offset + laps * _LAP)
                    yield from decode_words(chain([words], blocks), EVT3, state, self.path)

    def _words(self, message: _Message) -> NDArray[np.uint16]:
        if message.encoding != "evt3":
            problem = f"its packets are encoded as {message.encoding!r}; evt3 is read"
            raise DataError(self.path, problem, "republish them as dvs_msgs/EventArray with event_camera_tools")
        if len(message.content) % _WORD.itemsize:
            raise DataError(self.path, "a packet ends within a word", "copy it again")
        # Copied, so that the decoder is compiled for one kind of array.
        return message.content.view(_WORD).copy()

    @cached_property
    def _clock_offset(self) -> int:
        """Nanoseconds from the camera's clock to the clock of ROS."""
        offsets = [
            message.stamp - time
            for message in islice(self._messages(), _CLOCK_PACKETS)
            if (time := _first_time(self._words(message))) is not None
        ]
        if not offsets:
            return 0
        # The camera's times may have wrapped in between. A damaged one is far from the others.
        later = [(offset - offsets[0] + _LAP // 2) % _LAP - _LAP // 2 for offset in offsets]
        middle = sorted(later)[len(later) // 2]
        return offsets[0] + min(time for time in later if time > middle - _MAX_DELAY)

    def read_chunks(self) -> Iterator[EventStream]:
        yield from map(self._stream, self._columns())

    def read_time_span(self) -> tuple[int, int] | None:
        first = next(self._columns(), None)
        if first is None:
            return None
        with self._open() as bag:
            starts = [*(bag.end_time - seconds * 1_000_000_000 for seconds in _TAIL_SECONDS), None]
        for start in starts:
            if last := deque(self._columns(start), maxlen=1):
                return int(first[2][0]), int(last[0][2][-1])
        return None


def _begins(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(magic)) == magic


def _require_whole_bag(path: Path) -> None:
    """Raise a DataError for one file of a bag of ROS 2 that was split. The metadata beside it list the others."""
    metadata = path.parent / "metadata.yaml"
    if not metadata.is_file():
        return
    # Other programs use this name, too, so it need not be YAML that can be read.
    with metadata.open(encoding="utf-8", errors="replace") as file:
        listed = re.findall(r"^\s*- (\S+\.(?:mcap|db3)\S*)\s*$", file.read(MAX_HEADER), re.MULTILINE)
    if len(listed) > 1 and path.name in [Path(name).name for name in listed]:
        remedy = f"give its folder: --events {shlex.quote(str(path.parent))}, in aenerf --format-options events=..."
        raise DataError(path, f"it is one of the {len(listed)} files of a bag", remedy)


def _require_distinct_files(metadata: Path) -> None:
    """Raise a DataError for a bag of ROS 2 that lists a file twice: it would be read as often as it is listed."""
    # It has some kilobytes for each topic that many nodes publish.
    names = read_plain_yaml(metadata, MAX_HEADER)["rosbag2_bagfile_information"]["relative_file_paths"]
    if len(set(names)) < len(names):
        raise DataError(metadata, f"it lists {len(names)} files, {len(set(names))} of them distinct", "list each once")


def _require_records(path: Path) -> None:
    """Raise a DataError for an MCAP file with records of no kind: rosbags reads a file of zeros without end."""
    size = path.stat().st_size
    with path.open("rb") as file:
        position = len(_MCAP_MAGIC)
        while position < size:
            file.seek(position)
            head = file.read(9)
            kind, length = struct.unpack("<BQ", head) if len(head) == 9 else (0, 0)
            if kind == 0:
                raise DataError(path, f"it has no record at byte {position}", "copy it again")
            if kind == _MCAP_FOOTER:
                return
            position += len(head) + length


def _choose(path: Path, types: dict[str, str], topic: str | None) -> str:
    """Return the topic with the events, from the type of each topic."""
    known = sorted(name for name, kind in types.items() if kind in _PACKET_TYPES + _ARRAY_TYPES)
    if topic is None and len(known) == 1:
        return known[0]
    if topic in known:
        return topic
    if not known:
        found = ", ".join(sorted({kind.replace("/msg/", "/") for kind in types.values()})) or "nothing"
        problem = f"no topic holds events; the bag holds {found}"
        raise DataError(path, problem, "EventArray of dvs_msgs and EventPacket are read")
    problem = "several topics hold events" if topic is None else f"topic {topic} holds no events"
    raise DataError(path, problem, f"choose one of {', '.join(known)} as topic: {TOPIC_OPTION}")


class _Fields:
    """Read the fields of a serialized message, one after the other.

    In ROS 2 each number is aligned to its size, in ROS 1 it follows without padding.

    Raises:
        struct.error: the message ends too early, or has another byte order.
    """

    def __init__(self, data: bytes, is_aligned: bool) -> None:
        if is_aligned and data[: len(_CDR_HEADER)] != _CDR_HEADER:
            raise struct.error("not little-endian CDR")
        # Numbers are aligned relative to the end of the header.
        self._data = data[_CDR_HEADER_BYTES:] if is_aligned else data
        self._is_aligned = is_aligned
        self._position = 0

    def number(self, kind: str) -> int:
        """Return the next number, of a type of the module struct."""
        size = struct.calcsize(kind)
        self._position += -self._position % size if self._is_aligned else 0
        (value,) = struct.unpack_from(f"<{kind}", self._data, self._position)
        self._position += size
        return value

    def text(self) -> str:
        """Return the next string. Strings of ROS 2 end with a zero."""
        length = self.number("I")
        begin, self._position = self._position, self._position + length
        return self._data[begin : self._position].rstrip(b"\0").decode("ascii", "replace")

    def rest(self, size: int) -> bytes:
        """Return the last field, of a number of bytes."""
        rest = self._data[self._position :]
        if not size <= len(rest) < size + (_CDR_PADDING if self._is_aligned else 1):
            raise struct.error("the message has another length")
        return rest[:size]


def _parse(data: bytes, is_packet: bool, is_ros2: bool) -> _Message:
    """Split a serialized message.

    Raises:
        struct.error: the message is shorter or longer than its parts.
    """
    fields = _Fields(data, is_ros2)
    if not is_ros2:
        fields.number("I")  # sequence number of the header
    stamp = fields.number("I") * 1_000_000_000 + fields.number("I")
    fields.text()  # frame of the header
    height, width = fields.number("I"), fields.number("I")
    if is_packet:
        sequence = fields.number("Q")
        fields.number("Q")  # base of the times in other encodings
        encoding = fields.text()
        # Words are in the byte order of the camera, which this flag does not change.
        fields.number("?")
        content = np.frombuffer(fields.rest(fields.number("I")), np.uint8)
        return _Message(stamp, width, height, sequence, encoding, content)
    count = fields.number("I")
    events = _aligned_events(fields, count) if is_ros2 else fields.rest(count * _PACKED_EVENT.itemsize)
    return _Message(stamp, width, height, None, "", np.frombuffer(events, _ALIGNED_EVENT if is_ros2 else _PACKED_EVENT))


def _aligned_events(fields: _Fields, count: int) -> bytes:
    """Return the bytes of events of ROS 2 in steps of 16.

    Alignment puts two bytes between y and the time, and one byte behind the polarity. Only the first event has no bytes
    between y and the time, and only the last has no byte behind the polarity. Both are added here.
    """
    if count == 0:
        return fields.rest(0)
    data = fields.rest(_ALIGNED_EVENT.itemsize * count - 3)
    return data[:4] + data[2:] + b"\0"


def _first_time(words: NDArray[np.uint16]) -> int | None:
    """Return the first complete time of a packet in EVT 3.0 in nanoseconds, or None when the packet has none."""
    highs, lows = (np.flatnonzero(words >> 12 == kind) for kind in (0x8, 0x6))
    lows = lows[lows > highs[0]] if len(highs) else highs
    if len(lows) == 0:
        return None
    high = words[highs[highs < lows[0]][-1]]
    return ((int(high) & 0xFFF) << 12 | int(words[lows[0]]) & 0xFFF) * 1000
