"""Measure throughput and peak memory of the readers of event files, beside faery where it reads the format.

    python -m benchmarks.readers --output benchmarks/results/NAME.json

All files hold the same random events and are in the page cache. Each measurement has a process of its own, in which the
reader has read a small file before: compilation and imports do not count. The time is CPU time: other work on the
machine does not count either.
"""

from __future__ import annotations

import struct
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import faery
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_hdf5 import Hdf5EventWriter
from benchmarks.pairing import HEIGHT, WIDTH
from benchmarks.runs import in_own_process, peak_mib, run_benchmark, write_result

_START = 1_600_000_000_000_000
_VENDORS = (".raw", ".dat", ".aedat4")
# Slow to write, and therefore measured at the smallest size only.
_TEXT = (".csv", ".txt")


def events(count: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return x, y, t (microseconds from zero) and p (0 or 1): one event a microsecond on average, at random pixels."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.integers(0, 3, count))
    return rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count), t, rng.integers(0, 2, count)


def write_vendor(path: Path, count: int) -> None:
    """Write a vendor's format, in pieces of about 10 ms."""
    table = np.zeros(count, faery.EVENTS_DTYPE)
    table["x"], table["y"], table["t"], table["on"] = events(count)
    pieces = np.array_split(table, -(-count // 10_000))
    faery.file_encoder.events_to_file(pieces, path, (WIDTH, HEIGHT), "evt2" if path.suffix == ".raw" else None)


def evt3_words(count: int) -> NDArray[np.uint16]:
    """Return a time, a row and a column word for each event: no vectors, which is the worst case."""
    x, y, t, p = events(count)
    words = np.stack([0x6000 | t & 0xFFF, y, 0x2000 | p << 11 | x], -1).astype("<u2").reshape(-1)
    high = t >> 12
    changes = np.flatnonzero(np.diff(high, prepend=-1))
    return np.insert(words, 3 * changes, (0x8000 | high[changes] & 0xFFF).astype("<u2"))


def write_evt3(path: Path, count: int) -> None:
    """Write EVT 3.0."""
    header = f"% evt 3.0\n% geometry {WIDTH}x{HEIGHT}\n% end\n".encode()
    path.write_bytes(header + evt3_words(count).tobytes())


def _write_bag(path: Path, kind: str, messages: list[tuple[int, bytes]]) -> None:
    from rosbags.rosbag1 import Writer

    with Writer(path) as writer:
        connection = writer.add_connection("/events", kind, msgdef="# see the type's package", md5sum="0" * 32)
        for stamp, data in messages:
            seconds, nanoseconds = divmod(stamp, 10**9)
            header = struct.pack("<4I", 0, seconds, nanoseconds, 0) + struct.pack("<2I", HEIGHT, WIDTH)
            writer.write(connection, stamp, header + data)


def write_arrays(path: Path, count: int) -> None:
    """Write dvs_msgs/EventArray messages of 10 ms."""
    x, y, t, p = events(count)
    t += _START
    records = np.zeros(count, [("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
    records["x"], records["y"], records["p"] = x, y, p
    records["s"], records["ns"] = t // 1_000_000, t % 1_000_000 * 1000
    parts = np.split(records, np.searchsorted(t, np.arange(t[0] + 10_000, t[-1], 10_000)))
    messages = [
        (int(part["s"][0]) * 10**9 + int(part["ns"][0]), struct.pack("<I", len(part)) + part.tobytes())
        for part in parts
    ]
    _write_bag(path, "dvs_msgs/msg/EventArray", messages)


def write_packets(path: Path, count: int) -> None:
    """Write event_camera_msgs/EventPacket messages of 60,000 bytes of EVT 3.0, about 10 ms."""
    words = evt3_words(count)
    messages = []
    for i, part in enumerate(np.split(words, range(30_000, len(words), 30_000))):
        data = struct.pack("<2QI", i, 0, 4) + b"evt3\0" + struct.pack("<I", part.nbytes) + part.tobytes()
        messages.append((_START * 1000 + 10_000_000 * i, data))
    _write_bag(path, "event_camera_msgs/msg/EventPacket", messages)


def _table(count: int) -> NDArray[np.int64]:
    return np.stack(events(count), -1)


def write_native(path: Path, count: int) -> None:
    """Write the dataset format of this project (gzip)."""
    x, y, t, p = events(count)
    with Hdf5EventWriter(path) as writer:
        columns = x.astype(np.uint16), y.astype(np.uint16), t * 1000, (2 * p - 1).astype(np.int8)
        writer.append(EventStream(*columns, WIDTH, HEIGHT))


def write_blosc(path: Path, count: int) -> None:
    """Write the layout of TUM-VIE and DSEC (Blosc)."""
    import h5py
    import hdf5plugin

    dtypes = {"x": np.uint16, "y": np.uint16, "t": np.uint32, "p": np.uint8}
    with h5py.File(path, "w") as file:
        for (name, dtype), values in zip(dtypes.items(), events(count), strict=True):
            file.create_dataset(f"events/{name}", data=values.astype(dtype), chunks=True, **hdf5plugin.Blosc())
        file["ms_to_idx"] = np.zeros(1, np.uint64)
        file["t_offset"] = _START


def write_npy(path: Path, count: int) -> None:
    """Write a matrix of float64, as in E-NeRF's ESIM scenes."""
    np.save(path, _table(count).astype(np.float64))


def write_npz(path: Path, count: int) -> None:
    """Write an array for each column, compressed where the name says so."""
    save = np.savez_compressed if "compressed" in path.name else np.savez
    save(path, **dict(zip("xytp", events(count), strict=True)))


def write_csv(path: Path, count: int) -> None:
    """Write CSV with whole microseconds."""
    np.savetxt(path, _table(count), fmt="%d", delimiter=",", header="x,y,t,p", comments="")


def write_text(path: Path, count: int) -> None:
    """Write the text format of the Event Camera Dataset, with times in seconds."""
    table = _table(count)
    np.savetxt(path, np.column_stack([table[:, 2] * 1e-6, table[:, [0, 1, 3]]]), fmt=["%.6f", "%d", "%d", "%d"])


WRITERS: dict[str, Callable[[Path, int], None]] = {
    "evt2.raw": write_vendor,
    "evt3.raw": write_evt3,
    "cd.dat": write_vendor,
    "lz4.aedat4": write_vendor,
    "arrays.bag": write_arrays,
    "packets.bag": write_packets,
    "native.h5": write_native,
    "blosc.h5": write_blosc,
    "matrix.npy": write_npy,
    "plain.npz": write_npz,
    "compressed.npz": write_npz,
    "whole.csv": write_csv,
    "ecd.txt": write_text,
}


def count_events(reader: str, path: Path) -> int:
    """Read a file in chunks and return its number of events."""
    if reader == "aenerf":
        from aenerf_ns.files.open import open_event_file

        return sum(map(len, open_event_file(path, WIDTH, HEIGHT).chunks()))
    return sum(map(len, faery.events_stream_from_file(path)))


def measure(reader: str, small: Path, path: Path) -> dict[str, float]:
    """Read a file and return the throughput and the peak memory of this process."""
    count_events(reader, small)
    before = peak_mib()
    begin = time.process_time()
    count = count_events(reader, path)
    seconds = time.process_time() - begin
    row = {
        "events": count,
        "million_events_per_second": count / seconds / 1e6,
        "peak_mib": peak_mib(),
        "peak_mib_of_the_process_before": before,
    }
    if reader == "aenerf":
        from aenerf_ns.files.open import open_event_file

        begin = time.process_time()
        open_event_file(path, WIDTH, HEIGHT).time_span()
        row["seconds_of_time_span"] = time.process_time() - begin
    return row


@dataclass
class Readers:
    """Measure the readers of event files."""

    output: Path
    """JSON file to write."""
    sizes: tuple[int, ...] = (1_000_000, 10_000_000)
    """Numbers of events."""

    def main(self) -> None:
        """Measure and write the figures."""
        rows = []
        with tempfile.TemporaryDirectory() as folder:
            for name in WRITERS:
                small, path = Path(folder) / f"small_{name}", Path(folder) / name
                in_own_process(WRITERS[name], small, 1000)
                for size in self.sizes if path.suffix not in _TEXT else (min(self.sizes),):
                    path.unlink(missing_ok=True)
                    in_own_process(WRITERS[name], path, size)
                    for reader in ("aenerf", "faery") if path.suffix in _VENDORS else ("aenerf",):
                        measured = in_own_process(measure, reader, small, path)
                        row = {"file": name, "reader": reader, "mib": path.stat().st_size / 2**20, **measured}
                        rows.append(row)
        write_result(self.output, {"sensor": [WIDTH, HEIGHT], "rows": rows})


if __name__ == "__main__":
    run_benchmark(Readers)
