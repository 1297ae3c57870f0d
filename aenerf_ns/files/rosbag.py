"""Events in bags of ROS 1: arrays of events, and packets of encoded events.

* ``dvs_msgs/EventArray`` (and ``prophesee_event_msgs/EventArray``, which is equal):
  https://github.com/uzh-rpg/rpg_dvs_ros/tree/master/dvs_msgs/msg
* ``event_camera_msgs/EventPacket``: https://github.com/ros-event-camera/event_camera_msgs
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.files.sensor_size import sensor_size

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader

    from aenerf_ns.files.evt_words import Columns

_CHUNK = 1 << 20
_PACKET_TYPE = "event_camera_msgs/msg/EventPacket"
_ARRAY_TYPES = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
# As messages are serialized: without padding.
_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("seconds", "<u4"), ("nanoseconds", "<u4"), ("polarity", "?")])
_WORD = np.dtype("<u2")
# Nanoseconds after which the 24 bits of a time in EVT 3.0 come again.
_LAP = (1 << 24) * 1000
# Packets from which the clocks' difference is taken, about 0.4 s.
_CLOCK_PACKETS = 100
# Seconds before the end of a bag in which its last event is looked for.
_TAIL_SECONDS = (1, 10, 100)


@dataclass(frozen=True)
class _Message:
    """A message of either type; ``sequence`` is None for arrays, and ``stamp`` is in nanoseconds."""

    stamp: int
    width: int
    height: int
    sequence: int | None
    encoding: str
    payload: bytes


class RosbagEventFile(EventFile):
    """The events of one topic of a bag, at the times of ROS.

    The times of an EventPacket are those of the camera's own clock. One offset brings them all to the clock of ROS:
    the smallest difference between the stamp of a packet and its first time, among the first hundred packets. It is
    right up to the delay of the fastest of these packets, typically below a millisecond.

    Args:
        path: the bag.
        width: pixel columns of the sensor. Messages tell them; but with both sizes given, the bag is not opened before
            its events are asked for.
        height: pixel rows, likewise.
        topic: the topic, or None when only one holds events.

    Raises:
        DataError: a size is not given, and the bag is missing, cannot be read or holds no such topic, or the package
            rosbags is missing.
    """

    def __init__(
        self, path: Path, width: int | None = None, height: int | None = None, topic: str | None = None
    ) -> None:
        self.path = path
        self._topic = topic
        if width is None or height is None:
            first = next(self._messages(), None)
            if first is None:
                raise self.empty_error()
            width, height = sensor_size(path, (first.width, first.height), width, height)
        super().__init__(path, width, height)

    def _open(self) -> Reader:
        self.require()
        try:
            from rosbags.rosbag1 import Reader
        except ImportError:
            raise DataError(
                self.path, "a ROS bag is read with the package rosbags", "pip install 'aenerf-ns[rosbag]'"
            ) from None
        reader = Reader(self.path)
        try:
            reader.open()
        # Whatever its parser stumbles over.
        except Exception as error:
            raise self._damaged(error) from None
        return reader

    def _damaged(self, error: Exception) -> DataError:
        reason = str(error) or type(error).__name__
        return DataError(self.path, f"not a readable bag of ROS 1 ({reason})", "try `rosbag reindex` or copy it again")

    def _messages(self, start: int | None = None) -> Iterator[_Message]:
        """The topic's messages in the order in which they were received, from a time in nanoseconds on."""
        with closing(self._open()) as reader:
            chosen = _choose(self.path, reader.connections, self._topic)
            connections = [connection for connection in reader.connections if connection.topic == chosen.topic]
            messages = reader.messages(connections, start=start)
            while True:
                try:
                    connection, _, data = next(messages)
                except StopIteration:
                    return
                except Exception as error:
                    raise self._damaged(error) from None
                try:
                    yield _parse(data, connection.msgtype == _PACKET_TYPE)
                except (struct.error, IndexError):
                    raise DataError(
                        self.path, f"a message of {chosen.topic} does not have the parts of its type", "copy it again"
                    ) from None

    def _sized_messages(self, start: int | None) -> Iterator[_Message]:
        for message in self._messages(start):
            sensor_size(self.path, (message.width, message.height), self.width, self.height)
            yield message

    def _columns(self, start: int | None = None) -> Iterator[Columns]:
        """Columns x, y, t (nanoseconds) and p (±1) of the messages received from a time on."""
        first = next(self._messages(), None)
        if first is None:
            return
        if first.sequence is None:
            yield from self._columns_of_arrays(start)
        else:
            yield from self._columns_of_packets(start)

    def _columns_of_arrays(self, start: int | None) -> Iterator[Columns]:
        waiting: list[NDArray] = []
        count = 0
        for message in self._sized_messages(start):
            events = np.frombuffer(message.payload, _EVENT)
            waiting.append(events)
            count += len(events)
            if count >= _CHUNK:
                yield _array_columns(waiting)
                waiting, count = [], 0
        if count:
            yield _array_columns(waiting)

    def _columns_of_packets(self, start: int | None) -> Iterator[Columns]:
        # Late, for every command of every method would wait for numba.
        from aenerf_ns.files.evt_words import EVT3, decode_words, initial_state

        state = initial_state()

        def blocks() -> Iterator[NDArray]:
            offset = self._clock_offset()
            expected = None
            for message in self._sized_messages(start):
                words = self._words(message)
                if message.sequence != expected:
                    # The first packet, or packets before it were lost: what the decoder remembers is of no use.
                    expected = None
                    time = _first_time(words)
                    if time is None:
                        continue
                    laps = round((message.stamp - offset - time) / _LAP)
                    state[:] = initial_state(offset + laps * _LAP)
                expected = (message.sequence or 0) + 1
                yield words

        return decode_words(blocks(), EVT3, state, self.path)

    def _words(self, message: _Message) -> NDArray[np.uint16]:
        if message.encoding != "evt3":
            raise DataError(
                self.path,
                f"its packets are encoded as {message.encoding!r}; evt3 is read",
                "republish them as dvs_msgs/EventArray with event_camera_tools",
            )
        if len(message.payload) % _WORD.itemsize:
            raise DataError(self.path, "a packet ends within a word", "copy it again")
        # Copied, so that the decoder is compiled for one kind of array.
        return np.frombuffer(message.payload, _WORD).copy()

    def _clock_offset(self) -> int:
        """Nanoseconds from the camera's clock to that of ROS."""
        offsets = [
            message.stamp - time
            for message in islice(self._messages(), _CLOCK_PACKETS)
            if (time := _first_time(self._words(message))) is not None
        ]
        if not offsets:
            return 0
        # The camera's times may have wrapped in between.
        later = [(offset - offsets[0] + _LAP // 2) % _LAP - _LAP // 2 for offset in offsets]
        return offsets[0] + min(later)

    def read_chunks(self) -> Iterator[EventStream]:
        for x, y, t, p in self._columns():
            yield EventStream(x, y, t, p, self.width, self.height, self.path)

    def time_span(self) -> tuple[int, int]:
        first = next(self._columns(), None)
        if first is None:
            raise self.empty_error()
        with closing(self._open()) as reader:
            bag_end = reader.end_time
        for seconds in (*_TAIL_SECONDS, None):
            end = None
            for _, _, t, _ in self._columns(None if seconds is None else bag_end - seconds * 1_000_000_000):
                end = int(t[-1])
            if end is not None:
                return int(first[2][0]), end
        raise self.empty_error()


def _choose(path: Path, connections: list[Connection], topic: str | None) -> Connection:
    """The connection with the events."""
    known = {c.topic: c for c in connections if c.msgtype in (_PACKET_TYPE, *_ARRAY_TYPES)}
    if topic is None and len(known) == 1:
        return next(iter(known.values()))
    if topic in known:
        return known[topic]
    if not known:
        types = ", ".join(sorted({c.msgtype.replace("/msg/", "/") for c in connections})) or "nothing"
        raise DataError(
            path, f"no topic holds events; the bag holds {types}", "EventArray of dvs_msgs and EventPacket are read"
        )
    problem = "several topics hold events" if topic is None else f"topic {topic} holds no events"
    raise DataError(path, problem, f"choose one of {', '.join(sorted(known))} as topic")


def _parse(data: bytes, is_packet: bool) -> _Message:
    """Splits a serialized message.

    Raises:
        struct.error: it is shorter or longer than its parts.
    """
    _, seconds, nanoseconds, name_length = struct.unpack_from("<4I", data)
    position = 16 + name_length
    height, width = struct.unpack_from("<2I", data, position)
    position += 8
    sequence, encoding, item_size = None, "", _EVENT.itemsize
    if is_packet:
        sequence, _, length = struct.unpack_from("<2QI", data, position)
        position += 20
        encoding = data[position : position + length].decode("ascii", "replace")
        # Words are in the byte order of the camera, which the flag after the encoding does not change.
        position += length + 1
        item_size = 1
    (count,) = struct.unpack_from("<I", data, position)
    payload = data[position + 4 :]
    if len(payload) != count * item_size:
        raise struct.error("the array has another length")
    return _Message(seconds * 1_000_000_000 + nanoseconds, width, height, sequence, encoding, payload)


def _array_columns(arrays: list[NDArray]) -> Columns:
    events = np.concatenate(arrays)
    return (
        events["x"].astype(np.uint16),
        events["y"].astype(np.uint16),
        events["seconds"].astype(np.int64) * 1_000_000_000 + events["nanoseconds"],
        np.where(events["polarity"], 1, -1).astype(np.int8),
    )


def _first_time(words: NDArray[np.uint16]) -> int | None:
    """The first complete time of a packet in EVT 3.0 in nanoseconds, or None when it has none."""
    kinds = words >> 12
    highs = np.flatnonzero(kinds == 0x8)
    if len(highs) == 0:
        return None
    lows = np.flatnonzero(kinds == 0x6)
    lows = lows[lows > highs[0]]
    if len(lows) == 0:
        return None
    high = words[highs[highs < lows[0]][-1]]
    return ((int(high) & 0xFFF) << 12 | int(words[lows[0]]) & 0xFFF) * 1000
