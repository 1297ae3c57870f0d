"""Write bags of ROS 1 and ROS 2 that hold events."""

import shutil
import struct
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from helpers.event_file_writers import HEIGHT, WIDTH, Rows, evt3_words

ARRAY, PACKET = "dvs_msgs/msg/EventArray", "event_camera_msgs/msg/EventPacket"
_BEGINNING = "std_msgs/Header header\nuint32 height\nuint32 width\n"
_PACKET_DEFINITION = f"{_BEGINNING}uint64 seq\nuint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events"
_DEFINITIONS = {
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity",
    ARRAY: f"{_BEGINNING}dvs_msgs/Event[] events",
    PACKET: _PACKET_DEFINITION,
    # The earlier name of packets.
    "event_array_msgs/msg/EventArray": _PACKET_DEFINITION,
}
# The clock of ROS.
START = 1_600_000_000_000_000_000


def string(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def message_header(stamp: int, size: tuple[int, int]) -> bytes:
    seconds, nanoseconds = divmod(stamp, 10**9)
    return struct.pack("<3I", 0, seconds, nanoseconds) + string("camera") + struct.pack("<2I", size[1], size[0])


def array_message(rows: Rows, size: tuple[int, int] = (WIDTH, HEIGHT)) -> bytes:
    events = b"".join(struct.pack("<2H2IB", x, y, *divmod(t * 1000, 10**9), p > 0) for x, y, t, p in rows)
    return message_header(0, size) + struct.pack("<I", len(rows)) + events


def packet_message(sequence: int, stamp: int, payload: bytes, encoding: str = "evt3") -> bytes:
    return (
        message_header(stamp, (WIDTH, HEIGHT))
        + struct.pack("<2Q", sequence, 0)
        + string(encoding)
        + b"\0"
        + struct.pack("<I", len(payload))
        + payload
    )


def write_bag(path: Path, topics: dict[str, tuple[str, list[tuple[int, bytes]]]], compress: str = "") -> Path:
    """Writes (time, message) by type by topic."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    store = typestore("ROS1_NOETIC")
    path.unlink(missing_ok=True)
    writer = rosbag1.Writer(path)
    if compress:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compress])
    with writer:
        for topic, (kind, messages) in topics.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            for time, data in messages:
                writer.write(connection, time, data)
    return path


def array_bag(path: Path, rows: Rows, compress: str = "") -> Path:
    """Arrays of four events, the second and the last empty, beside a topic that goes on for 20 s."""
    parts = [rows[begin : begin + 4] for begin in range(0, len(rows), 4)]
    parts = [*parts[:1], [], *parts[1:], []]
    messages = [(rows[0][2] * 1000 + 1000 * i, array_message(part)) for i, part in enumerate(parts)]
    other = [(rows[0][2] * 1000 + 10**9 * i, b"\0") for i in range(20)]
    return write_bag(path, {"/dvs/events": (ARRAY, messages), "/imu": ("std_msgs/msg/Empty", other)}, compress)


def packet_messages(rows: Rows, times_of_arrival: list[int], words_per_packet: int) -> list[tuple[int, bytes]]:
    """Cuts the words of a stream into packets, wherever they end; each has one time of arrival."""
    words = evt3_words(rows)
    cuts = range(0, len(words), words_per_packet)
    return [
        (time, packet_message(i, time, words[cut : cut + words_per_packet].tobytes()))
        for i, (cut, time) in enumerate(zip(cuts, times_of_arrival, strict=False))
    ]


def write_bag2(path: Path, messages: list[tuple[int, bytes]], kind: str, storage: str = "SQLITE3") -> Path:
    """Write messages of ROS 1 as a bag of ROS 2, a folder, with one topic /events."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    store = typestore("ROS2_HUMBLE")
    shutil.rmtree(path, ignore_errors=True)
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage]) as writer:
        connection = writer.add_connection("/events", kind, typestore=store)
        for time, data in messages:
            writer.write(connection, time, store.ros1_to_cdr(data, kind))
    return path


@cache
def typestore(version: str) -> Any:
    """The types of a version of ROS, and those of events."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores[version])
    for kind, definition in _DEFINITIONS.items():
        store.register(get_types_from_msg(definition, kind))
    return store
