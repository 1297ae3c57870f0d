"""Bags of ROS 1 and ROS 2."""

import re
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from helpers.bag_writers import (
    ARRAY,
    PACKET,
    START,
    array_bag,
    array_message,
    packet_message,
    packet_messages,
    write_bag,
    write_bag2,
)
from helpers.event_file_checks import attempt, read, table, vendor_file
from helpers.event_file_writers import HEIGHT, WIDTH, evt3_words

from aenerf_ns.errors import DataError
from aenerf_ns.files import event_reader
from aenerf_ns.files.open import open_event_file

# A message with one event.
ONE = [(START, array_message([(1, 2, START // 1000, 1)]))]


@pytest.mark.parametrize("compress", ["", "LZ4", "BZ2"])
def test_arrays_of_events_in_a_bag(compress: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [(x, 47 - x // 2, START // 1000 + 300_000 * x, 1 - 2 * (x % 2)) for x in range(63)]
    file = open_event_file(array_bag(folder / "arrays.bag", rows, compress))
    assert (file.width, file.height) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(read(file), table(rows))
    assert file.time_span() == (rows[0][2] * 1000, rows[-1][2] * 1000)
    monkeypatch.setattr(event_reader, "CHUNK", 5)
    assert len(list(file.chunks())) == 8
    np.testing.assert_array_equal(read(file), table(rows))


def test_arrays_that_state_no_size_take_the_given_one(folder: Path) -> None:
    rows = [(1, 2, START // 1000, 1)]
    path = write_bag(folder / "zeros.bag", {"/events": (ARRAY, [(START, array_message(rows, (0, 0)))])})
    np.testing.assert_array_equal(read(open_event_file(path, WIDTH, HEIGHT)), table(rows))
    with pytest.raises(DataError, match="does not state the size"):
        open_event_file(path)


@pytest.mark.parametrize("kind", [PACKET, "event_array_msgs/msg/EventArray"])
def test_packets_have_the_times_of_ros(kind: str, folder: Path) -> None:
    # Ten seconds, which wrap once; two packets an event.
    rows = [(x, 5, 12_000_000 + 200_000 * x, 1 - 2 * (x % 2)) for x in range(50)]
    words = len(evt3_words(rows[:1]))
    assert words % 9 == 0
    # Received with a delay that is shortest, 2 ms, for the fourth event.
    arrivals = [START + 1000 * row[2] + (2_000_000 if row[0] == 3 else 5_000_000) for row in rows]
    messages = packet_messages(rows, arrivals, words)
    path = write_bag(folder / "packets.bag", {"/events": (kind, messages)})
    file = open_event_file(path)
    expected = table(rows)
    expected[:, 2] += START + 2_000_000
    np.testing.assert_array_equal(read(file), expected)
    assert file.time_span() == (expected[0, 2], expected[-1, 2])
    # Lost packets, also over more than a period of the camera's time, move nothing.
    rows = [(x, 5, 12_000_000 + 9_000_000 * x, 1) for x in range(50)]
    arrivals = [START + 1000 * row[2] for row in rows]
    messages = packet_messages(rows, arrivals, words)
    kept = [*range(5), 8, 9, *range(20, 50)]
    path = write_bag(path, {"/events": (kind, [messages[i] for i in kept])})
    expected = table(rows)[kept]
    expected[:, 2] += START
    np.testing.assert_array_equal(read(open_event_file(path)), expected)
    assert open_event_file(path).time_span() == (expected[0, 2], expected[-1, 2])


def test_lost_packets_reset_the_decoder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    packets = [[0x8001, 0x6001, 0x0005, 0x2001], [0x0006], [0x2002, 0x8001, 0x6003, 0x2003, 0x0007, 0x2004]]
    messages = [
        (START + i, packet_message(i, START + i, np.array(words, "<u2").tobytes())) for i, words in enumerate(packets)
    ]
    path = write_bag(folder / "lost.bag", {"/events": (PACKET, [messages[0], messages[2]])})
    # The events of the last packet before its row are at no known place.
    assert read(open_event_file(path))[:, :2].tolist() == [[1, 5], [4, 7]]
    said = "lost.bag: packets that were lost when it was recorded: 1."
    assert capsys.readouterr().out.count(said) == 1


@pytest.mark.parametrize(("packet", "word"), [(0, 0), (0, 4), (3, 0), (3, 4), (4, 4), (6, 0), (8, 0), (11, 4)])
def test_a_damaged_time_moves_no_later_packet(
    packet: int, word: int, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def packet_words(number: int) -> list[int]:
        # Two events of 1 ms, and between them the upper bits of the time again.
        time = 0x5000 + 1000 * number
        high, low = 0x8000 | time >> 12, 0x6000 | time & 0xFFF
        return [high, low, 0x0005, 0x2000 | number, high, low, 0x2010 | number]

    def events_of(packets: list[list[int]]) -> np.ndarray:
        messages = [
            (START + 1_000_000 * i, packet_message(i, START + 1_000_000 * i, np.array(words, "<u2").tobytes()))
            for i, words in enumerate(packets)
        ]
        # The sixth is lost.
        bag = write_bag(folder / "times.bag", {"/events": (PACKET, messages[:5] + messages[6:])})
        return read(open_event_file(bag))

    packets = [packet_words(number) for number in range(12)]
    expected = events_of(packets)
    assert len(expected) == 22
    packets[packet][word] ^= 0x800
    found = events_of(packets)
    assert {*map(tuple, found.tolist())} < {*map(tuple, expected.tolist())}
    assert len(found) >= 20
    assert "after a damaged time (the first at word" in capsys.readouterr().out


def test_real_packets_agree_with_independent_reader(folder: Path) -> None:
    faery = pytest.importorskip("faery")
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    path = vendor_file("evt3_packets.bag")
    file = open_event_file(path)
    events = read(file)
    with rosbag1.Reader(path) as reader:
        payloads = []
        for _, _, data in reader.messages():
            begin = data.index(b"\x04\0\0\0evt3") + 9
            payloads.append(data[begin + 4 :])
    raw = folder / "packets.raw"
    raw.write_bytes(b"% evt 3.0\n% geometry 640x480\n" + b"".join(payloads))
    other = faery.events_stream_from_file(raw).to_array()
    assert len(events) == len(other) == 343_474
    np.testing.assert_array_equal(events[:, 0], other["x"])
    np.testing.assert_array_equal(events[:, 1], other["y"])
    np.testing.assert_array_equal(events[:, 3] > 0, other["on"])
    times = other["t"].astype(np.int64) * 1000
    np.testing.assert_array_equal(events[:, 2] - events[0, 2], times - times[0])
    # No packet is stamped before its events, and the fastest not long after them.
    assert file.time_span() == (events[0, 2], events[-1, 2])
    assert events[0, 2] == 1_675_956_550_314_694_990


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("num_events", [1, 2, 63])
def test_arrays_of_events_in_a_bag_of_ros2(storage: str, num_events: int, folder: Path) -> None:
    rows = [(x, 47 - x // 2, START // 1000 + 300_000 * x, 1 - 2 * (x % 2)) for x in range(num_events)]
    parts = [rows, [], [(*row[:2], row[2] + 60_000_000, row[3]) for row in rows]]
    messages = [(part[0][2] * 1000 if part else START + 1, array_message(part)) for part in parts]
    path = write_bag2(folder / "arrays", messages, ARRAY, storage)
    (stored,) = (file for file in path.iterdir() if file.name != "metadata.yaml")
    for place in (path, stored):
        file = open_event_file(place)
        assert (file.width, file.height) == (WIDTH, HEIGHT)
        np.testing.assert_array_equal(read(file), table(parts[0] + parts[2]))
        assert file.time_span() == (rows[0][2] * 1000, parts[2][-1][2] * 1000)


def test_packets_of_ros2_equal_those_of_ros1(folder: Path) -> None:
    rows = [(x, 5, 12_000_000 + 200_000 * x, 1 - 2 * (x % 2)) for x in range(50)]
    messages = packet_messages(rows, [START + 1000 * row[2] for row in rows], len(evt3_words(rows[:1])))
    # One is lost.
    del messages[7]
    one = open_event_file(write_bag(folder / "packets.bag", {"/events": (PACKET, messages)}))
    two = open_event_file(write_bag2(folder / "packets", messages, PACKET))
    np.testing.assert_array_equal(read(one), read(two))
    assert one.time_span() == two.time_span()


def test_bag_of_ros2_without_metadata_opens(folder: Path) -> None:
    path = write_bag2(folder / "gone", ONE, ARRAY)
    file = open_event_file(path, WIDTH, HEIGHT)
    assert len(read(file)) == 1
    (path / "metadata.yaml").unlink()
    with pytest.raises(DataError, match=r"metadata.yaml: there is no such file"):
        file.time_span()


def test_a_part_of_a_bag_of_ros2_is_refused(folder: Path) -> None:
    path = write_bag2(folder / "split", ONE, ARRAY)
    (stored,) = path.glob("*.db3")
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(f"- {stored.name}", f"- {stored.name}\n  - other.db3", 1))
    assert "other.db3" in metadata.read_text()
    with pytest.raises(DataError, match=r"it is one of the 2 files of a bag; give its folder: --events .*/split, in"):
        read(open_event_file(stored, WIDTH, HEIGHT))


def test_an_interrupted_bag_can_be_repaired(folder: Path) -> None:
    (stored,) = write_bag2(folder / "cut", ONE, ARRAY, "MCAP").glob("*.mcap")
    alone = folder / "alone.mcap"
    alone.write_bytes(stored.read_bytes()[:-20])
    with pytest.raises(
        DataError, match=r"alone.mcap: .*; copy it again, or repair one that was cut off .mcap recover."
    ):
        read(open_event_file(alone, WIDTH, HEIGHT))


@pytest.mark.parametrize("cut", [1, 10, 30, 61])
def test_cut_message_of_ros2_is_one_line(cut: int, folder: Path) -> None:
    path = write_bag2(folder / "cut", ONE, ARRAY)
    (stored,) = path.glob("*.db3")
    with closing(sqlite3.connect(stored)) as database, database:
        (data,) = database.execute("SELECT data FROM messages").fetchone()
        database.execute("UPDATE messages SET data = ?", (data[:-cut],))
    with pytest.raises(DataError, match="does not have the parts of its type"):
        attempt(open_event_file(stored))
    with closing(sqlite3.connect(stored)) as database, database:
        # As middleware writes that pads messages.
        database.execute("UPDATE messages SET data = ?", (data + bytes(-len(data) % 4),))
    assert len(read(open_event_file(stored))) == 1


def test_choose_a_topic(folder: Path) -> None:
    path = write_bag(folder / "topics.bag", {"/left": (ARRAY, ONE), "/right": (ARRAY, ONE)})
    with pytest.raises(DataError, match="choose one of /left, /right as topic"):
        open_event_file(path)
    assert len(read(open_event_file(path, topic="/right"))) == 1
    with pytest.raises(DataError, match="topic /up holds no events; choose one of /left"):
        open_event_file(path, topic="/up")


def test_missing_package_for_bags_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / "missing_package.bag"
    path.write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(DataError, match=re.escape("pip install 'aenerf-ns[rosbag]'")):
        open_event_file(path)
