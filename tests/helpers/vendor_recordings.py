"""Recordings of one's own with an event file of each vendor's format, or with poses from COLMAP, and bombs in them."""

import bz2
import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from functools import cache, partial
from pathlib import Path

import numpy as np
import yaml

from aenerf_ns.dataparsers.own_recording import OwnRecordingDataParserConfig
from helpers.bag_writers import ARRAY, PACKET, array_message, packet_messages, write_bag, write_bag2
from helpers.dataset_faults import Change, all_of, edit_bytes, read_everything, sparse
from helpers.event_file_writers import HEIGHT, WIDTH, Rows, aedat4_file, aedat4_packet, dat, evt2, evt3, flat_table
from helpers.malformed_inputs import FORMAT_WRITERS, camchain
from helpers.own_recordings import write_calibration, write_poses
from helpers.published_datasets import CAMCHAIN, config_of, write_colmap, write_own

# From 0.1 to 0.7 s, four events a pixel.
ROWS: Rows = [(x % 30, 5 + x % 3, 100_000 + 5000 * x, 1 - 2 * (x // 30 % 2)) for x in range(120)]
STAMP = 10**8
PARTS = [ROWS[begin : begin + 20] for begin in range(0, len(ROWS), 20)]
NAME = "events"
_METADATA, _IMAGES = f"{NAME}/metadata.yaml", "colmap/images.bin"


def _around(folder: Path, write_events: Callable[[Path], object], suffix: str) -> Path:
    """Write calibration and poses, and the events beside them."""
    folder.mkdir()
    write_calibration(folder / "calibration.json", width=WIDTH, height=HEIGHT, cx=32.0, cy=24.0)
    write_poses(folder / "trajectory.txt", 1.0, 10)
    write_events(folder / f"{NAME}{suffix}")
    return folder


def _bytes(content: Callable[[Rows], bytes]) -> Change:
    return lambda path: path.write_bytes(content(ROWS))


def _messages() -> list[tuple[int, bytes]]:
    return [(STAMP + part[-1][2] * 1000, array_message(part)) for part in PARTS]


def _bag(path: Path, compress: str = "") -> None:
    write_bag(path, {"/events": (ARRAY, _messages())}, compress)


def _packets(path: Path) -> None:
    times = [10**8 + 10**7 * i for i in range(len(ROWS))]
    write_bag(path, {"/events": (PACKET, packet_messages(ROWS, times, 100))})


def _bag2(path: Path, storage: str) -> None:
    """The file in the folder of a bag of ROS 2."""
    folder = path.with_name("bag2")
    write_bag2(folder, _messages(), ARRAY, storage)
    shutil.move(next(folder.glob(f"*{path.suffix}")), path)
    shutil.rmtree(folder)


def _lz4(rows: Rows) -> bytes:
    from lz4.frame import compress

    return aedat4_file(rows, 1, compress, with_table=bool(rows))


def write_with_colmap(folder: Path) -> None:
    """A recording whose poses are COLMAP's, in its binary format."""
    truth = write_own(folder)
    (folder / "trajectory.txt").unlink()
    names = [f"{index:05d}.png" for index in range(3)]
    write_colmap(folder / "colmap", truth.poses[[0, 5, 10]], names, binary=True)


def write_with_camchain(folder: Path) -> None:
    """A recording whose calibration is Kalibr's."""
    write_own(folder)
    camchain(yaml.dump({"cam0": {**CAMCHAIN["cam1"], "T_cn_cnm1": np.eye(4).tolist()}}))(folder)


RECORDINGS: dict[str, Callable[[Path], object]] = {
    "evt2": partial(_around, write_events=_bytes(evt2), suffix=".raw"),
    "evt3": partial(_around, write_events=_bytes(evt3), suffix=".raw"),
    "dat": partial(_around, write_events=_bytes(dat), suffix=".dat"),
    "aedat4": partial(_around, write_events=_bytes(aedat4_file), suffix=".aedat4"),
    "aedat4 lz4": partial(_around, write_events=_bytes(_lz4), suffix=".aedat4"),
    "bag": partial(_around, write_events=_bag, suffix=".bag"),
    "bag lz4": partial(_around, write_events=partial(_bag, compress="LZ4"), suffix=".bag"),
    "bag packets": partial(_around, write_events=_packets, suffix=".bag"),
    "db3": partial(_around, write_events=partial(_bag2, storage="SQLITE3"), suffix=".db3"),
    "mcap": partial(_around, write_events=partial(_bag2, storage="MCAP"), suffix=".mcap"),
    "colmap": write_with_colmap,
    "camchain": write_with_camchain,
    "bag of ROS 2": partial(_around, write_events=lambda path: write_bag2(path, _messages(), ARRAY), suffix=""),
}
"""By a name: writes a whole recording to a folder."""

DATASETS = {**FORMAT_WRITERS, **RECORDINGS}
"""By a name: writes a whole dataset of a format, or a recording, to a folder."""


def read_dataset(kind: str, folder: Path) -> None:
    """Read all of a dataset of one of the kinds. The events of a recording may be a folder."""
    if kind not in RECORDINGS:
        read_everything(config_of(kind, folder))
        return
    events = folder / NAME
    read_everything(OwnRecordingDataParserConfig(data=folder, events=events if events.is_dir() else None))


# Bombs.


def _bag_chunk(compression: bytes, make_data: Callable[[], bytes], stated: int | None = None) -> Change:
    """Put other data in the only chunk of a bag of ROS 1, which states to unpack to 4 GB."""

    def change(content: bytes) -> bytes:
        data = make_data()
        # Behind the magic and the first record.
        begin = len(b"#ROSBAG V2.0\n") + 4096
        header_end = begin + 4 + struct.unpack_from("<I", content, begin)[0]
        end = header_end + 4 + struct.unpack_from("<I", content, header_end)[0]
        fields = [b"op=\x05", b"compression=" + compression, b"size=" + b"\xff" * 4]
        header = b"".join(struct.pack("<I", len(field)) + field for field in fields)
        length = len(data) if stated is None else stated
        chunk = struct.pack("<I", len(header)) + header + struct.pack("<I", length) + data
        # Where the index begins is in the first record.
        place = content.index(b"index_pos=") + len(b"index_pos=")
        (index,) = struct.unpack_from("<Q", content, place)
        index = struct.pack("<Q", index + len(chunk) - (end - begin))
        return content[:place] + index + content[place + 8 : begin] + chunk + content[end:]

    return edit_bytes("*.bag", change)


def _sql(*commands: str, make_data: Callable[[], bytes] | None = None) -> Change:
    """Run commands in a database; if data are given, as the value of every question mark."""

    def change(folder: Path) -> None:
        (path,) = folder.rglob("*.db3")
        with closing(sqlite3.connect(path)) as database, database:
            for command in commands:
                database.execute(command, [] if make_data is None else [make_data()])

    return change


_MCAP = b"\x89MCAP0\r\n"
_IN_EVERY_MESSAGE = "UPDATE messages SET data = ?"
_RENAMED = "ALTER TABLE messages RENAME TO others"


def _replace(pattern: str, old: bytes, new: bytes) -> Change:
    return edit_bytes(pattern, lambda content: content.replace(old, new))


def _compressed(mode: bytes) -> Change:
    return all_of(
        _replace(_METADATA, b"compression_mode: ''", b"compression_mode: " + mode),
        _replace(_METADATA, b"compression_format: ''", b"compression_format: zstd"),
    )


@cache
def zstd_bomb() -> bytes:
    from backports.zstd import ZstdCompressor

    packer = ZstdCompressor()
    return b"".join([packer.compress(bytes(1 << 26)) for _ in range(32)]) + packer.flush()


@cache
def lz4_bomb(beginning: bytes = b"") -> bytes:
    from lz4.frame import LZ4FrameCompressor

    packer = LZ4FrameCompressor()
    parts = [packer.begin(), packer.compress(beginning)]
    return b"".join([*parts, *(packer.compress(bytes(1 << 26)) for _ in range(32)), packer.flush()])


def _mcap_bomb(_: bytes) -> bytes:
    """An MCAP file of one chunk of 2 GB, without an index."""

    def record(kind: int, content: bytes) -> bytes:
        return struct.pack("<BQ", kind, len(content)) + content

    packed = zstd_bomb()
    head = struct.pack("<I4sI4s", 4, b"ros2", 4, b"none")
    chunk = struct.pack("<QQQII4sQ", STAMP, 2 * STAMP, 2 << 30, 0, 4, b"zstd", len(packed)) + packed
    return _MCAP + record(1, head) + record(6, chunk) + record(2, struct.pack("<QQI", 0, 0, 0)) + _MCAP


_ENDLESS = (
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id, i AS timestamp"
)


def _packet(beginning: bytes, packed: bytes) -> bytes:
    """An AEDAT4 file with one more packet of the stream of events."""
    return beginning + struct.pack("<2i", 0, len(packed)) + packed


def _zstd_packet(_: bytes) -> bytes:
    from backports.zstd import compress

    return _packet(aedat4_file([], 3, compress), zstd_bomb())


def _many_zeros(_: bytes) -> bytes:
    """Sixteen packets of 8 million events at one time."""
    from lz4.frame import compress

    size = 1 << 23
    events = flat_table(b"EVTS", [b""], 0, bytes(16 * size), size)
    packed = compress(struct.pack("<I", len(events)) + events)
    return aedat4_file([], 1, compress) + (struct.pack("<2i", 0, len(packed)) + packed) * 16


def _bag_number(name: bytes, number: bytes) -> Change:
    """Put another number into the first record of a bag of ROS 1."""

    def change(content: bytes) -> bytes:
        place = content.index(name) + len(name)
        return content[:place] + number + content[place + len(number) :]

    return edit_bytes("*.bag", change)


def _as_text(folder: Path) -> None:
    (folder / "colmap" / "images.bin").rename(folder / "colmap" / "images.txt")


_LAUGHS = (
    b"a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n"
    + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)).encode()
)
_AEDAT4, _COLMAP_LINE = "*.aedat4", b"1 1 0 0 0 0 0 0 1 a\n"
_ROS2_HEAD = struct.pack("<BQI4sI", 1, 12, 4, b"ros2", 0)

_BOMBS: dict[str, dict[str, Change]] = {
    "evt2": {"zeros without end": sparse("*.raw")},
    "evt3": {"only zeros": sparse("*.raw", b"% evt 3.0\n% geometry 64x48\n% end\n")},
    # Which are mapped, and that needs no memory. More than this could not be mapped within the limit of the test.
    "dat": {
        "zeros without end": sparse("*.dat", gigabytes=0.5),
        "only zeros": sparse("*.dat", dat([]), gigabytes=0.5),
    },
    "aedat4": {
        "zeros in place of packets": sparse(_AEDAT4, aedat4_file([])[:-100]),
        "a packet of 2 GB": all_of(
            edit_bytes(_AEDAT4, lambda b: b + struct.pack("<2i", 0, 2**31 - 1)), sparse(_AEDAT4)
        ),
        "a header of 4 GB": all_of(edit_bytes(_AEDAT4, lambda b: b[:14] + b"\xff" * 4), sparse(_AEDAT4)),
        "zstd that unpacks to 2 GB": edit_bytes(_AEDAT4, _zstd_packet),
    },
    "aedat4 lz4": {
        "a packet that unpacks to 2 GB": edit_bytes(
            _AEDAT4, lambda _: _packet(_lz4([]), lz4_bomb(aedat4_packet(ROWS)))
        ),
        "packets that unpack to 2 GB": edit_bytes(_AEDAT4, _many_zeros),
    },
    "bag": {
        "a chunk that says to have 4 GB": _bag_chunk(b"none", bytes, 2**32 - 1),
        "bz2 that unpacks to 2 GB": _bag_chunk(b"bz2", lambda: bz2.compress(bytes(1 << 24)) * 128),
        "zeros without end": all_of(_bag_number(b"index_pos=", struct.pack("<Q", 7 << 30)), sparse("*.bag")),
        "4 * 10^9 chunks": _bag_number(b"chunk_count=", b"\xff" * 4),
    },
    "bag lz4": {"lz4 that unpacks to 2 GB": _bag_chunk(b"lz4", lz4_bomb)},
    "db3": {
        "a view without end": _sql(_RENAMED, f"CREATE VIEW messages AS {_ENDLESS}, x'00' AS data FROM n"),
        "a view of 1 GB": _sql(
            _RENAMED, "CREATE VIEW messages AS SELECT id, topic_id, timestamp, zeroblob(999999999) AS data FROM others"
        ),
        "messages of zeros": _sql(_IN_EVERY_MESSAGE, make_data=lambda: bytes(1 << 20)),
    },
    "mcap": {
        "zeros without end": sparse("*.mcap", _MCAP, _MCAP),
        "zeros with a footer": sparse("*.mcap", _MCAP + _ROS2_HEAD, struct.pack("<BQQQI", 2, 20, 0, 0, 0) + _MCAP),
        "zstd that unpacks to 2 GB": edit_bytes("*.mcap", _mcap_bomb),
    },
    "bag of ROS 2": {
        "messages of 2 GB": all_of(_compressed(b"message"), _sql(_IN_EVERY_MESSAGE, make_data=zstd_bomb)),
        "a file of 2 GB": all_of(_compressed(b"file"), edit_bytes(f"{NAME}/*.db3", lambda _: zstd_bomb())),
        "metadata that multiply": edit_bytes(_METADATA, lambda _: _LAUGHS + b"rosbag2_bagfile_information: *a11\n"),
        "a file 10^5 times": _replace(_METADATA, b"  - events.db3\n", b"  - events.db3\n" * 5_000),
    },
    "colmap": {
        "10^18 images": edit_bytes(_IMAGES, lambda b: struct.pack("<Q", 10**18) + b[8:]),
        "zeros without end": all_of(edit_bytes(_IMAGES, lambda b: struct.pack("<Q", 10**6) + b[8:]), sparse(_IMAGES)),
        "10^12 features": _replace(_IMAGES, b".png\0" + struct.pack("<Q", 2), b".png\0" + struct.pack("<Q", 10**12)),
        "a name without end": edit_bytes(_IMAGES, lambda b: b[:80] + b"a" * 10**7),
        "a text without end": all_of(_as_text, sparse("colmap/images.txt", _COLMAP_LINE)),
        "a line without end": all_of(_as_text, sparse("colmap/images.txt", _COLMAP_LINE, gigabytes=2)),
    },
}
BOMBS = {f"{kind}: {name}": (kind, change) for kind, changes in _BOMBS.items() for name, change in changes.items()}
"""By a name: the kind of a whole recording, and the change that makes it one that must be refused."""
