"""Event files of cameras' vendors: real ones beside independent readers, made ones there and back, malformed ones."""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Callable
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
from conftest import FUZZ_EXAMPLES
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile
from aenerf_ns.files import aedat4, evt_words, prophesee_dat, prophesee_raw, rosbag
from aenerf_ns.files.open import open_event_file

_VENDOR_FILES = Path(__file__).parents[3] / "shared" / "data" / "vendor_formats"
_WIDTH, _HEIGHT = 64, 48

# Rows x, y, t in microseconds, p.
Rows = list[tuple[int, int, int, int]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for the files of all examples."""
    return tmp_path_factory.mktemp("event_files")


def vendor_file(name: str) -> Path:
    if not (_VENDOR_FILES / name).is_file():
        pytest.skip(f"the recording {name} is not at ../shared/data/vendor_formats")
    return _VENDOR_FILES / name


def read(file: EventFile) -> np.ndarray:
    """(N, 4) int64 x, y, t (nanoseconds) and p of all events, checked as training does."""
    parts = [np.stack([c.x, c.y, c.t, c.p], -1, dtype=np.int64, casting="unsafe") for c in file.chunks()]
    return np.concatenate(parts)


def table(rows: Rows) -> np.ndarray:
    return np.array(rows, dtype=np.int64) * [1, 1, 1000, 1]


# Encoders, written from the formats' descriptions.


def evt2(rows: Rows) -> bytes:
    words, high = [], None
    for x, y, t, p in rows:
        if (t >> 6) != high:
            high = t >> 6
            words.append(0x8 << 28 | high & 0xFFFFFFF)
        words.append((p > 0) << 28 | (t & 0x3F) << 22 | x << 11 | y)
    header = f"% evt 2.0\n% geometry {_WIDTH}x{_HEIGHT}\n% end\n".encode()
    return header + np.array(words, "<u4").tobytes()


def evt3_words(rows: Rows) -> np.ndarray:
    """Neighbouring events of one time, row and polarity are vectors; in between are words without events."""
    words: list[int] = []
    last_high = None
    for (t, y, p), group in groupby(rows, lambda row: (row[2], row[1], row[3])):
        high = t >> 12 & 0xFFF
        if t >> 12 != last_high:
            last_high = t >> 12
            words += [0x8000 | high] * 2
        words += [0x6000 | t & 0xFFF, y, 0xA001, 0xE123, 0xF456, 0x7007]
        polarity = 0x800 if p > 0 else 0
        columns = [row[0] for row in group]
        while columns:
            base = columns[0]
            run = 1
            while run < len(columns) and columns[run - 1] < columns[run] < base + 32:
                run += 1
            if run == 1:
                words.append(0x2000 | polarity | base)
            else:
                mask = sum(1 << (column - base) for column in columns[:run])
                words += [0x3000 | polarity | base, 0x4000 | mask & 0xFFF, 0x4000 | mask >> 12 & 0xFFF]
                words.append(0x5000 | mask >> 24)
            columns = columns[run:]
    return np.array(words, "<u2")


def evt3(rows: Rows) -> bytes:
    return f"% evt 3.0\n% format EVT3;height={_HEIGHT};width={_WIDTH}\n".encode() + evt3_words(rows).tobytes()


def dat(rows: Rows) -> bytes:
    words = [word for x, y, t, p in rows for word in (t & 0xFFFFFFFF, (p > 0) << 28 | y << 14 | x)]
    header = f"% Data file containing CD events\n% Version 2\n% Width {_WIDTH}\n% Height {_HEIGHT}\n".encode()
    return header + b"\x0c\x08" + np.array(words, "<u4").tobytes()


def flat_table(identifier: bytes, fields: list[bytes], vector: int, items: bytes, count: int) -> bytes:
    """A FlatBuffer of one table whose field number ``vector`` is a vector of items."""
    list_begin, table_begin = 8, 8 + (4 + 2 * len(fields) + 11) // 8 * 8
    size = 8 * (len(fields) + 1)
    places = [8 * (i + 1) for i in range(len(fields))]
    field_list = struct.pack(f"<{2 + len(fields)}H", 4 + 2 * len(fields), size, *places)
    body = struct.pack("<i", table_begin - list_begin).ljust(8, b"\0")
    # Items are aligned to 8 bytes: their number ends there.
    items_begin = table_begin + size + 4
    for i, field in enumerate(fields):
        value = struct.pack("<I", items_begin - (table_begin + places[i])) if i == vector else field
        body += value.ljust(8, b"\0")
    buffer = struct.pack("<I", table_begin) + identifier + field_list
    return buffer.ljust(table_begin, b"\0") + body + b"\0" * 4 + struct.pack("<I", count) + items


def sized(buffer: bytes) -> bytes:
    return struct.pack("<I", len(buffer)) + buffer


def aedat4_packet(rows: Rows) -> bytes:
    items = b"".join(struct.pack("<q2hB3x", t, x, y, p > 0) for x, y, t, p in rows)
    return sized(flat_table(b"EVTS", [b""], 0, items, len(rows)))


def aedat4_info(streams: dict[int, str], size: str) -> str:
    nodes = "".join(
        f'<node name="{number}"><attr key="typeIdentifier" type="string">{kind}</attr>'
        f'<node name="info">{size}</node></node>'
        for number, kind in streams.items()
    )
    return f'<dv version="2.0"><node name="outInfo">{nodes}</node></dv>'


AEDAT4_SIZE = f'<attr key="sizeX" type="int">{_WIDTH}</attr><attr key="sizeY" type="int">{_HEIGHT}</attr>'


def aedat4_file(
    rows: Rows,
    compression: int = 0,
    compress: Callable[[bytes], bytes] = bytes,
    streams: dict[int, str] | None = None,
    size: str = AEDAT4_SIZE,
    with_table: bool = False,
) -> bytes:
    """Packets of three events, between packets of another stream; with an empty packet."""
    packets = [(1, b"frame")]
    for begin in range(0, len(rows), 3):
        packets += [(0, compress(aedat4_packet(rows[begin : begin + 3]))), (1, b"frame")]
    packets.insert(3, (0, compress(aedat4_packet([]))))
    body = b"".join(struct.pack("<2i", stream, len(data)) + data for stream, data in packets)
    info = aedat4_info(streams or {0: "EVTS", 1: "FRME"}, size).encode()
    header_size = len(flat_table(b"IOHE", [b""] * 3, 2, info, len(info)))
    position = 14 + 4 + header_size + len(body) if with_table else -1
    fields = [struct.pack("<i", compression), struct.pack("<q", position), b""]
    header = flat_table(b"IOHE", fields, 2, info, len(info))
    return b"#!AER-DAT4.0\r\n" + sized(header) + body + (compress(aedat4_table(rows)) if with_table else b"")


def aedat4_table(rows: Rows) -> bytes:
    """A table of two packets of the stream of events, which hold half of the events each, and one of frames."""
    counts = [(0, len(rows) // 2), (1, 1), (0, len(rows) - len(rows) // 2)]
    # A row: the list of its fields' places, then the table: byte offset, (stream, size), number of items.
    row = [
        struct.pack("<5H", 10, 32, 8, 16, 24).ljust(16, b"\0") + struct.pack("<i4xq2iq", 16, 0, stream, 0, count)
        for stream, count in counts
    ]
    offsets = [4 * (len(row) - i) + 48 * i + 16 for i in range(len(row))]
    items = struct.pack(f"<{len(row)}I", *offsets) + b"".join(row)
    return sized(flat_table(b"FTAB", [b""], 0, items, len(row)))


ENCODERS = {"evt2": evt2, "evt3": evt3, "dat": dat, "aedat4": aedat4_file}
# Microseconds in which times can be told apart from wrapped ones, less a margin.
LONGEST_GAP = {"evt2": 8_000_000_000, "evt3": 16_600_000, "dat": 2_100_000_000, "aedat4": 10**15 // 100}


@st.composite
def recordings(draw: st.DrawFn, longest_gap: int) -> Rows:
    """Events with equal times, neighbours in a row, short and long gaps."""
    gap = st.one_of(st.just(0), st.integers(0, 5000), st.integers(0, longest_gap))
    rows, time = [], draw(st.integers(0, 20_000_000))
    for step, x, y, p, neighbours in draw(
        st.lists(
            st.tuples(
                gap,
                st.integers(0, _WIDTH - 1),
                st.integers(0, _HEIGHT - 1),
                st.sampled_from([-1, 1]),
                st.lists(st.integers(1, 4), max_size=12),
            ),
            min_size=1,
            max_size=30,
        )
    ):
        time += step
        columns = np.cumsum([x, *neighbours])
        rows += [(int(column), y, time, p) for column in columns if column < _WIDTH]
    # The first time of such a file is only known up to its laps.
    return rows


def lapless(rows: Rows, lap: int) -> np.ndarray:
    """The rows as a reader sees them that does not know how often the time wrapped before the first event."""
    expected = table(rows)
    expected[:, 2] -= (rows[0][2] // lap) * lap * 1000
    return expected


_LAPS = {"evt2": 1 << 34, "evt3": 1 << 24, "dat": 1 << 32, "aedat4": 1 << 60}


@pytest.mark.parametrize("name", ENCODERS)
def test_what_was_encoded_is_read_whatever_the_size_of_the_pieces(name: str, folder: Path) -> None:
    @settings(max_examples=60, deadline=None)
    @given(recordings(LONGEST_GAP[name]), st.integers(12, 60), st.integers(1, 9))
    def check(rows: Rows, chunk: int, block: int) -> None:
        path = folder / f"there_and_back.{name}"
        path.write_bytes(ENCODERS[name](rows))
        expected = lapless(rows, _LAPS[name])
        for is_small in (False, True):
            with pytest.MonkeyPatch.context() as patch:
                if is_small:
                    for module in (evt_words, prophesee_dat, aedat4):
                        patch.setattr(module, "_CHUNK", chunk)
                    patch.setattr(prophesee_raw, "_BLOCK", block)
                file = open_event_file(path)
                assert (file.width, file.height) == (_WIDTH, _HEIGHT)
                np.testing.assert_array_equal(read(file), expected)
                assert file.time_span() == (expected[0, 2], expected[-1, 2])
                assert file.count() in (None, len(rows))

    check()


@pytest.mark.parametrize("name", ["evt3.raw", "evt2.raw", "gen4.dat", "davis346.aedat4"])
def test_real_files_agree_with_an_independent_reader(name: str) -> None:
    faery = pytest.importorskip("faery")
    path = vendor_file(name)
    # Its header does not tell; the camera is a Gen3 VGA.
    size = (640, 480) if name == "evt2.raw" else (None, None)
    events = read(open_event_file(path, *size))
    other = faery.events_stream_from_file(path, dimensions_fallback=(640, 480)).to_array()
    np.testing.assert_array_equal(events[:, 0], other["x"])
    np.testing.assert_array_equal(events[:, 1], other["y"])
    np.testing.assert_array_equal(events[:, 2], other["t"].astype(np.int64) * 1000)
    np.testing.assert_array_equal(events[:, 3] > 0, other["on"])


@pytest.mark.parametrize(
    ("name", "size", "count", "first", "last"),
    [
        ("evt2.raw", (640, 480), 521_252, (35, 443, 913_716_224_000, 1), (12, 471, 913_812_095_000, -1)),
        ("evt3.raw", (1280, 720), 1_218_618, (484, 315, 11_200_224_000, 1), (471, 350, 21_968_221_000, -1)),
        ("gen4.dat", (1280, 720), 1_218_618, (484, 315, 5_856_000, 1), (471, 350, 10_773_853_000, -1)),
        (
            "davis346.aedat4",
            (346, 260),
            78_830,
            (215, 164, 1_589_163_147_368_868_000, 1),
            (233, 205, 1_589_163_149_728_813_000, 1),
        ),
    ],
)
def test_real_files(
    name: str, size: tuple[int, int], count: int, first: tuple[int, ...], last: tuple[int, ...]
) -> None:
    file = open_event_file(vendor_file(name), *size)
    events = read(file)
    assert len(events) == count
    assert tuple(events[0]) == first
    assert tuple(events[-1]) == last
    assert file.time_span() == (first[2], last[2])
    assert file.count() == (None if name.endswith(".raw") else count)


def test_two_formats_of_one_recording_hold_the_same_events() -> None:
    raw, dat = (read(open_event_file(vendor_file(name))) for name in ("evt3.raw", "gen4.dat"))
    # The conversion to DAT moved the clock.
    raw[:, 2] -= raw[0, 2] - dat[0, 2]
    np.testing.assert_array_equal(raw, dat)


def test_pieces_of_real_files_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    files = [open_event_file(vendor_file(name)) for name in ("evt3.raw", "gen4.dat", "davis346.aedat4")]
    whole = [read(file) for file in files]
    for module in (evt_words, prophesee_dat, aedat4):
        monkeypatch.setattr(module, "_CHUNK", 10_007)
    monkeypatch.setattr(prophesee_raw, "_BLOCK", 9_973)
    for file, events in zip(files, whole, strict=True):
        assert max(map(len, file.chunks())) < 11_000
        np.testing.assert_array_equal(read(file), events)


def test_a_long_recording_in_evt3_keeps_its_time_over_many_wraps(folder: Path) -> None:
    rng = np.random.default_rng(0)
    # Six hours, with breaks of up to 16 s without a word.
    times = np.cumsum(rng.integers(0, 16_000_000, 2700))
    rows = [(int(x), 3, int(t), 1) for x, t in zip(rng.integers(0, _WIDTH, len(times)), times, strict=True)]
    path = folder / "long.raw"
    path.write_bytes(evt3(rows))
    assert times[-1] > 1000 * (1 << 24)
    np.testing.assert_array_equal(read(open_event_file(path)), lapless(rows, 1 << 24))


def test_words_before_the_first_time_are_left_out(folder: Path) -> None:
    path = folder / "late.raw"
    words = [0x2005, 0x0007, 0x2006, 0x8001, 0x2007, 0x3008, 0x4FFF, 0x6002, 0x2009]
    path.write_bytes(b"% evt 3.0\n% geometry 64x48\n" + np.array(words, "<u2").tobytes())
    np.testing.assert_array_equal(read(open_event_file(path)), [[9, 7, (0x1002) * 1000, -1]])


@pytest.mark.parametrize("block", [1, 100])
def test_the_upper_bits_of_a_time_take_effect_before_the_lower_ones_follow(
    block: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prophesee_raw, "_BLOCK", block)
    path = folder / "upper.raw"
    words = [0x8001, 0x6FFF, 0x0007, 0x2001, 0x8002, 0x2002, 0x8002, 0x6003, 0x8002, 0x2003]
    path.write_bytes(b"% evt 3.0\n% geometry 64x48\n" + np.array(words, "<u2").tobytes())
    assert (read(open_event_file(path))[:, 2] // 1000).tolist() == [0x1FFF, 0x2000, 0x2003]


def test_a_recording_that_goes_back_in_time_is_rejected(folder: Path) -> None:
    for name, step in (("evt2", 1000), ("evt3", 60_000), ("dat", 1), ("aedat4", 1)):
        path = folder / f"back.{name}"
        path.write_bytes(ENCODERS[name]([(1, 1, 1_000_000, 1), (2, 2, 1_000_000 - step, 1)]))
        with pytest.raises(DataError, match="before the event ahead of it"):
            read(open_event_file(path))


def test_the_size_comes_from_the_file_or_else_from_its_user(folder: Path) -> None:
    rows = [(1, 2, 3, 1)]
    path = folder / "sized.raw"
    without = evt2(rows).replace(f"% geometry {_WIDTH}x{_HEIGHT}\n".encode(), b"")
    path.write_bytes(without)
    with pytest.raises(DataError, match="does not state the size"):
        open_event_file(path)
    file = open_event_file(path, 10, 20)
    assert (file.width, file.height) == (10, 20)
    for encode in ENCODERS.values():
        path.write_bytes(encode(rows))
        with pytest.raises(DataError, match=r"64 x 48 pixels, but 10 x 20 were given"):
            open_event_file(path, 10, 20).time_span()
    path.write_bytes(aedat4_file(rows, size=""))
    with pytest.raises(DataError, match="does not state the size"):
        open_event_file(path)
    np.testing.assert_array_equal(read(open_event_file(path, 10, 20)), table(rows))


@pytest.mark.parametrize(("compression", "package"), [(1, "lz4.frame"), (2, "lz4.frame"), (4, "backports.zstd")])
def test_compressed_packets_of_aedat4(
    compression: int, package: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compress = pytest.importorskip(package).compress
    rows = [(x, 7, 1_600_000_000_000_000 + x, 1 - 2 * (x % 2)) for x in range(20)]
    path = folder / "packed.aedat4"
    path.write_bytes(aedat4_file(rows, compression, compress, with_table=True))
    file = open_event_file(path)
    np.testing.assert_array_equal(read(file), table(rows))
    assert file.count() == len(rows)
    assert file.time_span() == (rows[0][2] * 1000, rows[-1][2] * 1000)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DataError, match=re.escape("pip install 'aenerf-ns[aedat4]'")):
        read(file)


def test_one_of_several_streams_of_aedat4(folder: Path) -> None:
    path = folder / "stereo.aedat4"
    path.write_bytes(aedat4_file([(1, 2, 3, 1)], streams={0: "EVTS", 4: "EVTS"}))
    with pytest.raises(DataError, match="several streams hold events; choose one of 0, 4"):
        open_event_file(path)
    assert len(read(open_event_file(path, topic="0"))) == 1
    with pytest.raises(DataError, match="holds no events"):
        read(open_event_file(path, topic="4"))


def test_a_trained_run_opens_without_its_events(folder: Path) -> None:
    for suffix in ("raw", "dat", "aedat4", "bag", "h5", "npy", "txt"):
        file = open_event_file(folder / f"gone.{suffix}", _WIDTH, _HEIGHT)
        assert (file.width, file.height) == (_WIDTH, _HEIGHT)
        with pytest.raises(DataError, match="there is no such event file"):
            file.time_span()
        with pytest.raises(DataError, match="there is no such event file"):
            next(file.chunks())


def test_the_content_tells_the_format(folder: Path) -> None:
    for name, encode in ENCODERS.items():
        path = folder / "misnamed.txt"
        path.write_bytes(encode([(1, 2, 3, 1)]))
        assert read(open_event_file(path)).tolist() == [[1, 2, 3000, 1]], name


# Bags.

_ARRAY_DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
dvs_msgs/Event[] events
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: dvs_msgs/Event
uint16 x
uint16 y
time ts
bool polarity
"""
_PACKET_DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
"""


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def message_header(stamp: int, size: tuple[int, int]) -> bytes:
    seconds, nanoseconds = divmod(stamp, 10**9)
    return struct.pack("<3I", 0, seconds, nanoseconds) + text("camera") + struct.pack("<2I", size[1], size[0])


def array_message(rows: Rows, size: tuple[int, int] = (_WIDTH, _HEIGHT)) -> bytes:
    events = b"".join(struct.pack("<2H2IB", x, y, *divmod(t * 1000, 10**9), p > 0) for x, y, t, p in rows)
    return message_header(0, size) + struct.pack("<I", len(rows)) + events


def packet_message(sequence: int, stamp: int, payload: bytes, encoding: str = "evt3") -> bytes:
    return (
        message_header(stamp, (_WIDTH, _HEIGHT))
        + struct.pack("<2Q", sequence, 0)
        + text(encoding)
        + b"\0"
        + struct.pack("<I", len(payload))
        + payload
    )


def write_bag(path: Path, topics: dict[str, tuple[str, list[tuple[int, bytes]]]], compress: str = "") -> Path:
    """Writes (time, message) by type by topic."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    path.unlink(missing_ok=True)
    writer = rosbag1.Writer(path)
    if compress:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compress])
    with writer:
        for topic, (kind, messages) in topics.items():
            definition = _PACKET_DEFINITION if kind.endswith("EventPacket") else _ARRAY_DEFINITION
            connection = writer.add_connection(topic, kind, msgdef=definition, md5sum="0" * 32)
            for time, data in messages:
                writer.write(connection, time, data)
    return path


ARRAY, PACKET = "dvs_msgs/msg/EventArray", "event_camera_msgs/msg/EventPacket"
# The clock of ROS.
START = 1_600_000_000_000_000_000


def array_bag(path: Path, rows: Rows, compress: str = "") -> Path:
    """Arrays of four events, the second and the last empty, beside a topic that goes on for 20 s."""
    parts = [rows[begin : begin + 4] for begin in range(0, len(rows), 4)]
    parts = [*parts[:1], [], *parts[1:], []]
    messages = [(rows[0][2] * 1000 + 1000 * i, array_message(part)) for i, part in enumerate(parts)]
    other = [(rows[0][2] * 1000 + 10**9 * i, b"\0") for i in range(20)]
    return write_bag(path, {"/dvs/events": (ARRAY, messages), "/imu": ("std_msgs/msg/Empty", other)}, compress)


@pytest.mark.parametrize("compress", ["", "LZ4", "BZ2"])
def test_arrays_of_events_in_a_bag(compress: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [(x, 47 - x // 2, START // 1000 + 300_000 * x, 1 - 2 * (x % 2)) for x in range(63)]
    file = open_event_file(array_bag(folder / "arrays.bag", rows, compress))
    assert (file.width, file.height) == (_WIDTH, _HEIGHT)
    np.testing.assert_array_equal(read(file), table(rows))
    assert file.time_span() == (rows[0][2] * 1000, rows[-1][2] * 1000)
    monkeypatch.setattr(rosbag, "_CHUNK", 5)
    assert len(list(file.chunks())) == 8
    np.testing.assert_array_equal(read(file), table(rows))


def packet_messages(rows: Rows, times_of_arrival: list[int], words_per_packet: int) -> list[tuple[int, bytes]]:
    """Cuts the words of a stream into packets, wherever they end; each has one time of arrival."""
    words = evt3_words(rows)
    cuts = range(0, len(words), words_per_packet)
    return [
        (time, packet_message(i, time, words[cut : cut + words_per_packet].tobytes()))
        for i, (cut, time) in enumerate(zip(cuts, times_of_arrival, strict=False))
    ]


def test_packets_of_events_in_a_bag_are_at_the_times_of_ros(folder: Path) -> None:
    # Ten seconds, which wrap once; two packets an event.
    rows = [(x, 5, 12_000_000 + 200_000 * x, 1 - 2 * (x % 2)) for x in range(50)]
    words = len(evt3_words(rows[:1]))
    assert words % 9 == 0
    # Received with a delay that is shortest, 2 ms, for the fourth event.
    arrivals = [START + 1000 * row[2] + (2_000_000 if row[0] == 3 else 5_000_000) for row in rows]
    messages = packet_messages(rows, arrivals, words)
    path = write_bag(folder / "packets.bag", {"/events": (PACKET, messages)})
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
    path = write_bag(path, {"/events": (PACKET, [messages[i] for i in kept])})
    expected = table(rows)[kept]
    expected[:, 2] += START
    np.testing.assert_array_equal(read(open_event_file(path)), expected)
    assert open_event_file(path).time_span() == (expected[0, 2], expected[-1, 2])


def test_what_a_decoder_remembers_does_not_outlive_lost_packets(folder: Path) -> None:
    packets = [[0x8001, 0x6001, 0x0005, 0x2001], [0x0006], [0x2002, 0x8001, 0x6003, 0x2003, 0x0007, 0x2004]]
    messages = [
        (START + i, packet_message(i, START + i, np.array(words, "<u2").tobytes())) for i, words in enumerate(packets)
    ]
    path = write_bag(folder / "lost.bag", {"/events": (PACKET, [messages[0], messages[2]])})
    # The events of the last packet before its row are at no known place.
    assert read(open_event_file(path))[:, :2].tolist() == [[1, 5], [4, 7]]


def test_real_packets_agree_with_an_independent_reader_of_their_words(folder: Path) -> None:
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


def test_one_of_several_topics(folder: Path) -> None:
    array = [(START, array_message([(1, 2, START // 1000, 1)]))]
    path = write_bag(folder / "topics.bag", {"/left": (ARRAY, array), "/right": (ARRAY, array)})
    with pytest.raises(DataError, match="choose one of /left, /right as topic"):
        open_event_file(path)
    assert len(read(open_event_file(path, topic="/right"))) == 1
    with pytest.raises(DataError, match="topic /up holds no events; choose one of /left"):
        open_event_file(path, topic="/up")


def test_a_missing_package_for_bags_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / "missing_package.bag"
    path.write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(DataError, match=re.escape("pip install 'aenerf-ns[rosbag]'")):
        open_event_file(path)


# Malformed files.

ROWS: Rows = [(x, 5 + x % 3, 100_000 + 1000 * x, 1 - 2 * (x % 2)) for x in range(30)]
HEADER2, HEADER3 = b"% evt 2.0\n% geometry 64x48\n", b"% evt 3.0\n% geometry 64x48\n"


def words(dtype: str, *values: int) -> bytes:
    return np.array(values, dtype).tobytes()


MALFORMED: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "the file is empty"),
    "unknown": (b"RIFF....WAVE", "its format is not known"),
    "raw with a header alone": (HEADER3, "holds no events"),
    "raw with an endless header": (b"% evt 3.0\n% geometry 64x48", "does not end"),
    "raw with an endless line": (b"% evt 3.0\n% " + b"x" * 100_000, "does not end"),
    "raw without an encoding": (b"% format \n% geometry 64x48\n" + words("<u2", 0x8001), "does not tell the encoding"),
    "raw in another encoding": (b"% evt 2.1\n% geometry 64x48\n", "encoded as 2.1"),
    "raw of histograms": (b"% format HISTO3D;width=64\n", "encoded as HISTO3D"),
    "raw in big endian": (b"% format EVT3;endianness=big;width=64;height=48\n", "encoded as EVT3;endianness=big"),
    "raw of no size": (b"% evt 3.0\n", "does not state the size"),
    "raw of an absurd size": (b"% evt 3.0\n% geometry 999999x999999\n", "999999 x 999999 pixels cannot be"),
    "raw of size zero": (b"% evt 3.0\n% geometry 0x48\n", "0 x 48 pixels cannot be"),
    "evt2 cut": (evt2(ROWS)[:-1], "ends within a word of 4 bytes"),
    "evt3 cut": (evt3(ROWS)[:-1], "ends within a word of 2 bytes"),
    "evt2 garbage": (HEADER2 + words("<u4", 0x80000001, 0x70000000), "word 1 is 0x70000000, which EVT 2.0"),
    "evt3 garbage": (HEADER3 + words("<u2", 0x8001, 0x6000, 0x9123), "word 2 is 0x9123, which EVT 3.0"),
    "evt2 beside the sensor": (HEADER2 + words("<u4", 0x80000001, 64 << 11), "x = 64 on a sensor of width 64"),
    "evt3 beside the sensor": (HEADER3 + words("<u2", 0x8001, 0x6000, 0x0030, 0x2001), "y = 48 on a sensor of height"),
    "evt3 vectors that never end": (
        HEADER3 + words("<u2", 0x8001, 0x6000, 0x0001, 0x3000, *[0x4001] * 6000),
        "on a sensor of width 64",
    ),
    "evt3 without a time": (HEADER3 + words("<u2", 0x0001, 0x2001), "holds no events"),
    "evt3 without a row": (HEADER3 + words("<u2", 0x8001, 0x6000, 0x2001), "holds no events"),
    "evt2 read as evt3": (HEADER3 + evt2(ROWS).split(b"% end\n")[1], ""),
    "dat cut": (dat(ROWS)[:-1], "ends within a record of 8 bytes"),
    "dat without records": (dat([]), "holds no events"),
    "dat without a type": (dat([])[:-2], "type and size none"),
    "dat of triggers": (dat(ROWS).replace(b"\x0c\x08", b"\x0e\x08"), "type and size 0e 08"),
    "dat of version 1": (dat(ROWS).replace(b"Version 2", b"Version 1"), "its version is 1"),
    "dat without a version": (dat(ROWS).replace(b"% Version 2\n", b""), "its version is none"),
    "dat beside the sensor": (dat([(64, 1, 0, 1)]), "x = 64 on a sensor of width 64"),
    "dat of polarity 2": (dat([])[:] + words("<u4", 0, 2 << 28), "has polarity 3"),
    "aedat of version 2": (b"#!AER-DAT2.0\r\n# events", "does not begin as an AEDAT4 file"),
    "aedat4 with its magic alone": (b"#!AER-DAT4.0\r\n", "header"),
    "aedat4 cut in its header": (aedat4_file(ROWS)[:100], "ends within its header"),
    "aedat4 with a header of zeros": (b"#!AER-DAT4.0\r\n" + sized(bytes(64)), "header cannot be read"),
    "aedat4 without events": (aedat4_file(ROWS, streams={0: "FRME"}), "no stream holds events"),
    "aedat4 of no number": (aedat4_file(ROWS).replace(b'node name="0"', b'node name="?"'), "header cannot be read"),
    "aedat4 of an unknown compression": (aedat4_file(ROWS, compression=9), "compression is number 9"),
    "aedat4 of another compression": (aedat4_file(ROWS, compression=1), ""),
    "aedat4 cut in a packet": (aedat4_file(ROWS)[:-20], "ends within the packet"),
    "aedat4 cut in a packet's head": (aedat4_file(ROWS)[:-10], "ends within the packet"),
    "aedat4 that ends before its table": (aedat4_file(ROWS, with_table=True)[:-300], "ends before its table"),
    "aedat4 of other packets": (aedat4_file(ROWS).replace(b"EVTS\x06", b"FRME\x06"), "does not hold events"),
    "aedat4 beside the sensor": (aedat4_file([(64, 1, 0, 1)]), "x = 64 on a sensor of width 64"),
    "aedat4 at an absurd time": (aedat4_file([(1, 1, 1 << 62, 1)]), "more than 292 years"),
    "bag with its magic alone": (b"#ROSBAG V2.0\n", "not a readable bag"),
    "bag of version 1": (b"#ROSBAG V1.2\n", "not a readable bag"),
}


def attempt(path: Path) -> None:
    """Reads all there is to read, as `aenerf convert` would."""
    file = open_event_file(path)
    file.count()
    start, end = file.time_span()
    chunks = list(file.chunks())
    assert (start, end) == (chunks[0].t[0], chunks[-1].t[-1])


def assert_one_line(error: DataError, path: Path) -> None:
    assert str(error).startswith(f"{path}: ")
    assert "\n" not in str(error)
    assert len(str(error)) < 400


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_are_told_in_one_line(name: str, folder: Path) -> None:
    content, message = MALFORMED[name]
    if name.startswith("bag"):
        pytest.importorskip("rosbags")
    path = folder / name.replace(" ", "_")
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        attempt(path)
    assert_one_line(caught.value, path)
    assert message in str(caught.value)


def malformed_bags() -> dict[str, tuple[str, list[tuple[int, bytes]], str]]:
    good = array_message(ROWS)
    packet = packet_message(0, START, evt3_words(ROWS).tobytes())
    return {
        "no events": (ARRAY, [(START, array_message([]))], "holds no events"),
        "cut": (ARRAY, [(START, good[:-1])], "does not have the parts"),
        "cut in its header": (ARRAY, [(START, good[:10])], "does not have the parts"),
        "of another length": (ARRAY, [(START, good + b"\0")], "does not have the parts"),
        "of two sizes": (
            ARRAY,
            [(START, good), (START + 1, array_message(ROWS, (9, 9)))],
            "has 9 x 9 pixels, but 64 x 48",
        ),
        "out of order": (ARRAY, [(START, good), (START + 1, good)], "before the event ahead of it"),
        "of another encoding": (PACKET, [(START, packet_message(0, START, b"", "libcaer"))], "encoded as 'libcaer'"),
        "within a word": (PACKET, [(START, packet_message(0, START, b"\1\2\3"))], "ends within a word"),
        "of no time": (PACKET, [(START, packet_message(0, START, words("<u2", 1, 0x2001)))], "holds no events"),
        "of garbage": (PACKET, [(START, packet), (START + 1, packet_message(1, START, b"\0\x90"))], "0x9000"),
        "of nothing we know": ("sensor_msgs/msg/Image", [(START, b"")], "the bag holds sensor_msgs/Image"),
    }


@pytest.mark.parametrize("name", malformed_bags())
def test_malformed_bags_are_told_in_one_line(name: str, folder: Path) -> None:
    kind, messages, message = malformed_bags()[name]
    path = write_bag(folder / "malformed.bag", {"/events": (kind, messages)})
    with pytest.raises(DataError) as caught:
        attempt(path)
    assert_one_line(caught.value, path)
    assert message in str(caught.value)


def test_paths_that_are_no_files(folder: Path) -> None:
    for path, message in ((folder, "it is a folder"), (folder / "none.raw", "there is no such event file")):
        with pytest.raises(DataError, match=message):
            open_event_file(path)


def made_files(folder: Path) -> dict[str, bytes]:
    """One small file of each kind."""
    files = {name: encode(ROWS) for name, encode in ENCODERS.items()}
    files["aedat4 with a table"] = aedat4_file(ROWS, with_table=True)
    try:
        from lz4.frame import compress

        files["aedat4 in lz4"] = aedat4_file(ROWS, 1, compress, with_table=True)
    except ImportError:
        pass
    try:
        import rosbags  # noqa: F401

        rows = [(x, y, START // 1000 + t, p) for x, y, t, p in ROWS]
        for compress_bag in ("", "LZ4", "BZ2"):
            files[f"arrays {compress_bag}"] = array_bag(folder / "fuzz_base.bag", rows, compress_bag).read_bytes()
        messages = packet_messages(ROWS, [START + 1000 * row[2] for row in ROWS], 9)
        files["packets"] = write_bag(folder / "fuzz_base.bag", {"/events": (PACKET, messages)}).read_bytes()
    except ImportError:
        pass
    return files


# What is done to a file, at places given as fractions of its length.
_EDITS = st.lists(
    st.tuples(
        st.sampled_from(["set", "flip", "cut", "insert", "repeat", "number"]),
        st.floats(0, 1, exclude_max=True),
        st.one_of(st.integers(0, 255), st.sampled_from([0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40])),
    ),
    max_size=6,
)


def edited(content: bytes, edits: list[tuple[str, float, int]]) -> bytes:
    data = bytearray(content)
    for kind, fraction, value in edits:
        place = int(fraction * len(data))
        if kind == "cut":
            del data[place : place + 1 + value % 64 if value < 2**31 else len(data)]
        elif kind == "insert":
            data[place:place] = value.to_bytes(6, "little")
        elif kind == "repeat":
            data[place:place] = data[place : place + value % 256]
        elif kind == "number":
            data[place : place + 4] = (value & 0xFFFFFFFF).to_bytes(4, "little")
        elif place < len(data):
            data[place] = value & 0xFF if kind == "set" else data[place] ^ (1 << value % 8)
    return bytes(data)


def survives(path: Path) -> None:
    """Reads a file that may hold anything: its events are in order and on the sensor, or there is one clear error."""
    try:
        file = open_event_file(path)
        file.count()
        file.time_span()
        for chunk in file.chunks():
            assert len(chunk)
    except DataError as error:
        assert_one_line(error, path)


def test_damaged_files_raise_nothing_but_clear_errors(folder: Path) -> None:
    files = made_files(folder)
    path = folder / "fuzz"

    @settings(max_examples=FUZZ_EXAMPLES * 5, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(sorted(files)), _EDITS)
    def check(name: str, edits: list[tuple[str, float, int]]) -> None:
        path.write_bytes(edited(files[name], edits))
        survives(path)

    for content in files.values():
        path.write_bytes(content)
        attempt(path)
    check()


def beginning_of(name: str) -> bytes:
    """A whole file of the first 40,000 bytes or so of a recording."""
    content = vendor_file(name).read_bytes()
    if name.endswith("aedat4"):
        # Without a table of packets, and up to the end of one.
        content = content[:54] + struct.pack("<q", -1) + content[62:]
        end = 18 + int.from_bytes(content[14:18], "little")
        while end < 40_000:
            end += 8 + int.from_bytes(content[end + 4 : end + 8], "little")
        return content[:end]
    header = re.match(rb"(% [^\n]*\n)+", content)
    assert header
    return content[: header.end() + (2 if name.endswith("dat") else 0) + 40_000]


def test_real_files_that_are_damaged_raise_nothing_but_clear_errors(folder: Path) -> None:
    files = {name: beginning_of(name) for name in ("evt3.raw", "gen4.dat", "davis346.aedat4")}
    path = folder / "fuzz_real"

    @settings(max_examples=FUZZ_EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(sorted(files)), _EDITS)
    def check(name: str, edits: list[tuple[str, float, int]]) -> None:
        path.write_bytes(edited(files[name], edits))
        survives(path)

    for content in files.values():
        path.write_bytes(content)
        attempt(path)

    check()


def test_bytes_after_a_beginning_raise_nothing_but_clear_errors(folder: Path) -> None:
    path = folder / "fuzz_magic"
    magics = [HEADER2, HEADER3, dat([]), b"% ", b"#!AER-DAT4.0\r\n", b"#ROSBAG V2.0\n", b""]

    @settings(max_examples=FUZZ_EXAMPLES, deadline=None)
    @given(st.sampled_from(magics), st.binary(max_size=400))
    def check(magic: bytes, content: bytes) -> None:
        path.write_bytes(magic + content)
        survives(path)

    check()
