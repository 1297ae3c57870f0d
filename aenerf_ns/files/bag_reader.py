"""Bags of ROS 1 and ROS 2 by the package rosbags, which itself puts no limit on what a bag unpacks to.

The package is imported where a bag is opened, because it is optional.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from aenerf_ns.files.limits import require_unpacked_size
from aenerf_ns.files.plain_yaml import read_plain_yaml
from aenerf_ns.files.unpacking import MAX_PIECE, unpacked

if TYPE_CHECKING:
    from rosbags import rosbag1, rosbag2
    from rosbags.interfaces import Connection

_BLOCK = 1 << 22
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_MCAP_FOOTER = 0x02


class Bag:
    """The messages of a bag. Close it after use.

    Args:
        path: a bag of ROS 1; or of ROS 2, as a folder with metadata.yaml or as a single .db3 or .mcap file.
        is_ros2: whether it is of ROS 2.

    Raises:
        ImportError: the package rosbags is missing.
        DataError: the bag unpacks to far more than it holds.
        Exception: whatever the package stumbles over in a damaged bag.

    Attributes:
        connections: the topics, each with its type. A topic of several files appears once for each file.
        end_time: nanoseconds after the last message.
    """

    def __init__(self, path: Path, is_ros2: bool) -> None:
        self._path = path
        self._unpack_message: Callable[[bytes], bytes] = bytes
        with ExitStack() as stack:
            self._readers = self._open_ros2(stack) if is_ros2 else [_opened_ros1(path, stack)]
            self._stack = stack.pop_all()
        files = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else [path]
        self._packed = sum(file.stat().st_size for file in files)
        self.connections: list[Connection] = [item for reader in self._readers for item in reader.connections]
        self.end_time: int = max((reader.end_time for reader in self._readers), default=0)

    def close(self) -> None:
        """Close the files."""
        self._stack.close()

    def messages(self, topic: str, start: int | None = None) -> Iterator[tuple[str, bytes]]:
        """Yield the type and the bytes of the messages of a topic, from a time in nanoseconds on.

        Raises:
            DataError: the messages have far more bytes than the bag.
            Exception: whatever the package stumbles over in a damaged bag.
        """
        total = 0
        for reader in self._readers:
            chosen = [connection for connection in reader.connections if connection.topic == topic]
            # The package takes no choice for all.
            for connection, _, data in reader.messages(chosen, start=start) if chosen else ():
                data = self._unpack_message(data)
                total += len(data)
                require_unpacked_size(self._path, f"the topic {topic}", total, self._packed)
                yield connection.msgtype, data

    def _open_ros2(self, stack: ExitStack) -> list[rosbag2.Reader]:
        files, mode = ([self._path], "") if self._path.is_file() else _files_of(self._path)
        if mode == "message":
            self._unpack_message = lambda data: unpacked(data, "zstd")
        elif mode == "file":
            folder = Path(stack.enter_context(TemporaryDirectory()))
            files = [_decompressed(file, folder) for file in files]
        return [_opened_ros2(file, stack) for file in files]


def _opened_ros1(path: Path, stack: ExitStack) -> rosbag1.Reader:
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag1.reader import decompressors

    names = {function: name for name, function in decompressors.items() if name != "none"}
    reader = Reader(path)
    reader.open()
    stack.callback(reader.close)
    size = path.stat().st_size
    for position, chunk in reader.chunks.items():
        if chunk.datasize > MAX_PIECE or chunk.datapos + chunk.datasize > size:
            raise ValueError(f"its chunk at byte {chunk.datapos} says to have {chunk.datasize:,} bytes")
        if chunk.decompressor in names:
            bounded = _bounded(names[chunk.decompressor])
            reader.chunks[position] = chunk._replace(decompressor=bounded)
    return reader


def _bounded(compression: str) -> Callable[..., bytes]:
    return lambda data, *_: unpacked(data, compression)


def _files_of(folder: Path) -> tuple[list[Path], str]:
    """Return the files of a bag of ROS 2 in their order, and what is compressed in it: "", "message" or "file"."""
    meta = read_plain_yaml(folder / "metadata.yaml")
    try:
        meta = meta["rosbag2_bagfile_information"]
        names: Sequence[str] = meta["relative_file_paths"]
        # Early versions repeat the folder's name.
        files = [folder / PurePath(name).name for name in names]
        mode = str(meta.get("compression_mode", "")).lower().replace("none", "")
        compression = meta.get("compression_format") or "zstd"
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"metadata.yaml does not list its files: {error!r}") from None
    if mode not in ("", "message", "file") or (mode and compression != "zstd"):
        raise ValueError(f"metadata.yaml names the compression {compression!r} of {mode!r}")
    if not files or len(set(files)) < len(files):
        raise ValueError(f"metadata.yaml lists {len(files)} files, or one twice")
    return files, mode


def _decompressed(file: Path, folder: Path) -> Path:
    """Write the decompressed copy of a file to a folder."""
    from backports import zstd

    copy, packed, total = folder / file.stem, file.stat().st_size, 0
    with file.open("rb") as source, zstd.open(source, "rb") as content, copy.open("wb") as target:
        while block := content.read(_BLOCK):
            total += len(block)
            require_unpacked_size(file, "the file", total, packed)
            target.write(block)
    return copy


def _opened_ros2(path: Path, stack: ExitStack) -> rosbag2.Reader:
    from rosbags.rosbag2 import Reader, storage_mcap

    if path.suffix == ".db3":
        _require_tables(path)
    elif path.suffix == ".mcap":
        _require_records(path)
        storage_mcap.DECOMPRESSORS.update({name: _bounded(name) for name in ("lz4", "zstd")})
    reader = Reader(path)
    reader.open()
    stack.callback(reader.close)
    chunks: Sequence[Any] = getattr(reader.storage, "chunks", ())
    if len({chunk.chunk_start_offset for chunk in chunks}) < len(chunks):
        raise ValueError("its index lists a chunk twice")
    size = sum(chunk.uncompressed_size for chunk in chunks)
    require_unpacked_size(path, "its chunks", size, path.stat().st_size)
    return reader


def _require_tables(path: Path) -> None:
    """Raise a ValueError for a database with anything but plain tables. A view could compute rows without end."""
    if set("%?#") & set(str(path)):
        raise ValueError("its path holds %, ? or #, which SQLite takes for parts of an address: rename it")
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            items = database.execute("SELECT type, name, sql FROM sqlite_master LIMIT 101").fetchall()
            kinds = {kind for kind, *_ in items}
            tables = [name for kind, name, _ in items if kind == "table"]
            columns = [
                row for name in tables for row in database.execute("SELECT * FROM pragma_table_xinfo(?)", [name])
            ]
    except sqlite3.Error as error:
        raise ValueError(str(error)) from None
    virtual = any(str(sql).upper().startswith("CREATE VIRTUAL") for *_, sql in items)
    # The last value of a row tells whether a column is computed.
    if len(items) > 100:
        raise ValueError("its database has more than 100 tables")
    if not kinds <= {"table", "index"} or virtual or any(row[-1] for row in columns):
        raise ValueError("its database computes what it holds")


def _require_records(path: Path) -> None:
    """Raise a ValueError for an MCAP file with records of no kind, such as a file of zeros, which would have no end."""
    size = path.stat().st_size
    with path.open("rb") as file:
        place = len(_MCAP_MAGIC)
        while place < size:
            file.seek(place)
            head = file.read(9)
            kind, length = struct.unpack("<BQ", head) if len(head) == 9 else (0, 0)
            if kind == 0:
                raise ValueError(f"it has no record at byte {place}")
            if kind == _MCAP_FOOTER:
                return
            place += len(head) + length
