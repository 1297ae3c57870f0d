"""Malformed event files of every format: one clear line each."""

import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.bag_writers import ARRAY, PACKET, START, array_bag, array_message, packet_message, write_bag
from helpers.event_file_checks import assert_one_line, attempt
from helpers.event_file_writers import HEADER2, HEADER3, ROWS, aedat4_file, dat, evt2, evt3_of, evt3_words, words
from helpers.event_table_writers import HEIGHT, WIDTH, ZEROS, N, T, made_columns, records, replaced

from aenerf_ns.errors import DataError
from aenerf_ns.files import event_text
from aenerf_ns.files.open import open_event_file


def write_with_filter(path: Path, code: int) -> None:
    """Events in a compression for which no filter exists here."""
    with h5py.File(path, "w") as file:
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk((N,))
        settings.set_filter(code, h5py.h5z.FLAG_OPTIONAL, ())
        kind = h5py.h5t.py_create(records(made_columns()).dtype)
        group = file.create_group("CD")
        dataset = h5py.h5d.create(group.id, b"events", kind, h5py.h5s.create_simple((N,)), settings)
        dataset.write_direct_chunk((0,), b"compressed", 0)


def bag(*messages: bytes, kind: str = ARRAY) -> Callable[[Path], object]:
    """Write a bag of messages that were received one nanosecond after another."""
    timed = [(START + index, message) for index, message in enumerate(messages)]
    return lambda path: write_bag(path, {"/events": (kind, timed)})


def packets(*payloads: bytes, encoding: str = "evt3") -> Callable[[Path], object]:
    return bag(*(packet_message(i, START, payload, encoding) for i, payload in enumerate(payloads)), kind=PACKET)


ARRAYS = array_message(ROWS)


# By the suffix of the file and a name: its content, or how it is written, and a part of the message.
FAULTS: dict[str, tuple[bytes | Callable[[Path], object], str]] = {
    "aedat4: of version 2": (b"#!AER-DAT2.0\r\n# events", "does not begin as an AEDAT4 file"),
    "aedat4: with its magic alone": (b"#!AER-DAT4.0\r\n", "not a readable AEDAT4 file"),
    "aedat4: without events": (aedat4_file(ROWS, streams={0: "FRME"}), "no stream holds events"),
    "aedat4: of an unknown compression": (aedat4_file(ROWS, compression=9), "compression is number 9"),
    "aedat4: cut in a packet": (aedat4_file(ROWS)[:-20], r"ends within a packet at byte .* \(--drop-malformed\)"),
    "aedat4: that ends before its table": (aedat4_file(ROWS, with_table=True)[:-300], "ends before its table"),
    "aedat4: of other packets": (aedat4_file(ROWS).replace(b"EVTS\x06", b"FRME\x06"), "does not hold events"),
    "aedat4: at an absurd time": (aedat4_file([(1, 1, 1 << 62, 1)]), "more than 292 years"),
    "dat: cut": (dat(ROWS)[:-1], r"ends within a record of 8 bytes at .* \(--drop-malformed\)"),
    "dat: without a type": (dat([])[:-2], "type and size none"),
    "dat: of triggers": (dat(ROWS).replace(b"\x0c\x08", b"\x0e\x08"), "type and size 0e 08"),
    "dat: of version 1": (dat(ROWS).replace(b"Version 2", b"Version 1"), "its version is 1"),
    "dat: of polarity 2": (dat([])[:] + words("<u4", 0, 2 << 28), "has polarity 3"),
    "raw: with a header alone": (HEADER3, "holds no events"),
    "raw: with an endless header": (b"% evt 3.0\n% geometry 64x48", "does not end"),
    "raw: without an encoding": (b"% format \n% geometry 64x48\n" + words("<u2", 0x8001), "does not state the encod"),
    "raw: in another encoding": (b"% evt 2.1\n% geometry 64x48\n", "encoded as 2.1"),
    "raw: of histograms": (b"% format HISTO3D;width=64;height=48\n", "encoded as HISTO3D"),
    "raw: in big endian": (b"% format EVT3;endianness=big;width=64;height=48\n", "encoded as EVT3;endianness=big"),
    "raw: of an absurd size": (b"% evt 3.0\n% geometry 999999x999999\n", "999999 x 999999 pixels is too large"),
    "raw: of size zero": (b"% evt 3.0\n% geometry 0x48\n", "0 x 48 pixels cannot be"),
    "raw: evt2 cut": (evt2(ROWS)[:-1], "ends within a word of 4 bytes"),
    "raw: evt2 garbage": (HEADER2 + words("<u4", 0x80000001, 0x70000000), "word 1 is 0x70000000, which EVT 2.0"),
    "raw: evt3 garbage": (evt3_of(0x8001, 0x6000, 0x9998), "word 2 is 0x9998, which EVT 3.0"),
    "raw: evt3 beside the sensor": (evt3_of(0x8001, 0x6000, 0x0030, 0x2001), "y = 48 on a sensor of height"),
    "raw: evt3 vectors that never end": (evt3_of(0x8001, 0x6000, 1, 0x3000, *[0x4001] * 6000), "on a sensor of width"),
    "raw: empty": (b"", "the file is empty"),
    "raw: packed": (b"\x1f\x8b" + bytes(30), "its format is not known .* csv and text are read, unpacked"),
    "bag: of version 1": (b"#ROSBAG V1.2\n", "not a readable bag"),
    "bag: without an index": (
        lambda path: path.write_bytes(
            re.sub(rb"index_pos=.{8}", b"index_pos=" + bytes(8), array_bag(path, ROWS).read_bytes(), flags=re.DOTALL)
        ),
        "it has no index, .*; rosbag reindex ",
    ),
    "bag: no events": (bag(array_message([])), "holds no events"),
    "bag: of another length": (bag(ARRAYS + b"\0"), "does not have the parts"),
    "bag: of two sizes": (bag(ARRAYS, array_message(ROWS, (9, 9))), "has 9 x 9 pixels, but 64 x 48"),
    "bag: out of order": (bag(ARRAYS, ARRAYS), "before the event ahead of it"),
    "bag: of another encoding": (packets(b"", encoding="libcaer"), "encoded as 'libcaer'"),
    "bag: within a word": (packets(b"\1\2\3"), "ends within a word"),
    "bag: of no time": (packets(words("<u2", 1, 0x2001)), "holds no events"),
    "bag: of garbage": (packets(evt3_words(ROWS).tobytes(), b"\0\x90"), "0x9000"),
    "bag: of nothing we know": (bag(b"", kind="sensor_msgs/msg/Image"), "the bag holds sensor_msgs/Image"),
    "npz: of text": (b"x y", "not a readable .npz file"),
    "npy: of text": (b"x y", "not a readable .npy file"),
    "npz: array of objects": (replaced("x", np.array([object] * N)), "not a readable array x .it holds Python objects"),
    "npz: no events in npz": (replaced("p", None), "its arrays are t, x, y; it must hold x, y, t and p"),
    "npz: empty stream": (lambda path: np.savez(path, **dict.fromkeys("xytp", ZEROS[:0])), "the file holds no events"),
    "npz: matrix as column": (replaced("x", np.zeros((N, 2), int)), r"x has shape \(300, 2\)"),
    "npy: three columns": (lambda path: np.save(path, np.zeros((9, 3))), "has 3 columns; column 3 must hold p"),
    "npy: one column": (lambda path: np.save(path, np.zeros(9)), r"has shape \(9,\)"),
    "npy: records without p": (lambda path: np.save(path, np.zeros(9, "u2, u2")), "have no field"),
    "npz: words": (replaced("x", np.array(["one"] * N)), "column x has type <U3; store numbers"),
    "npz: fractional pixel": (replaced("y", ZEROS + 0.5), "event 0 has y = 0.5; it must be a whole number"),
    "npz: three polarities": (replaced("p", np.arange(N) % 3 - 1), "event 1 has p = 0; .* -1 beside it"),
    "npz: NaN time": (replaced("t", np.full(N, np.nan)), "event 0 has t = nan; check the unit"),
    "npz: unsorted": (replaced("t", T[::-1].copy()), "not sorted by time"),
    "h5: of text": (b"\x89HDF\r\n\x1a\nx y", "not a readable HDF5 file"),
    "h5: no events in HDF5": (replaced("p", None), "it holds t, x, y; events must be in"),
    "h5: without anything": (lambda path: h5py.File(path, "w").close(), "it holds nothing"),
    "h5: short column": (replaced("x", np.zeros(3, int)), "its columns have lengths"),
    "h5: negative pixel": (replaced("y", ZEROS - 1), "event 0 has y = -1"),
    "h5: polarity 2": (replaced("p", ZEROS + 2), "event 0 has p = 2; polarities are 0 and 1, or -1 and 1"),
    "h5: huge time": (replaced("t", T * 1_000), r"event 0 has t = 1\.6e\+18; check the unit"),
    "h5: ECF": (lambda path: write_with_filter(path, 0x8ECF), "ECF filter: .* set HDF5_PLUGIN_PATH to its folder"),
    "h5: another filter": (lambda path: write_with_filter(path, 40_000), r"pip install 'aenerf-ns\[hdf5-"),
    "csv: seconds and nanoseconds": (b"secs,nsecs,x,y,p\n1,5,2,3,1\n", "first line is 'secs,nsecs,x,y,p'; it must"),
    "csv: without header": (b"1,2,3,1\n", "first line is '1,2,3,1'; it must name"),
    "csv: with a word": (b"x,y,t,p\n1,2,now,1\n", "line 2 has t = now; write"),
    "csv: with five": (b"x,y,t,p\n1,2,3,1,9\n", "has 5 fields: '1,2,3,1,9'; .* the 4, between commas or blanks"),
    "csv: with blanks between": (b"x,y,t,p\n1,2 3,4,1\n", "line 2 has y = 2 3;"),
    "csv: with three polarities": (b"x,y,t,p\n1,2,3,-1\n#\n1,2,3,0\n", "line 4 has p = 0; .* of polarity -1"),
    "txt: with half a pixel": (b"1 2.5 1 1\n", "line 1 has x = 2.5; it must be a whole number"),
    "txt: with a fault later": (b"# made\n" + b"1 1 2 1\n" * 50 + b"1 1 two 1\n1 1 2 1\n", "line 52 has y = two"),
    "txt: with a bad pixel later": (
        b"#\n" + b"1 1 2 1\n" * 50 + b"\n1 60 2 1\n1 1 2 1\n",
        "line 53 has x = 60; .* below 60",
    ),
    "txt: with a bad end": (b"1 1 2 1\n" * 90 + b"1 1 2\n", "the last line has 3"),
    "txt: without line ends": (b"1 1 2 1 " * 90, "line 1 has 360 fields"),
    "txt: in UTF-16": ("1 2 3 1\n".encode("utf-16"), "it is text in UTF-16"),
    "csv: with semicolons": (b"1;2;3;1\n", "line 1 has 1 fields: '1;2;3;1'"),
    "csv: of another size": (b"%geometry:640,480\n1,2,1,3\n", "its sensor has 640 x 480 pixels, but"),
}


@pytest.mark.parametrize("name", FAULTS, ids=lambda name: name.replace(" ", "_"))
def test_malformed_event_file_is_one_line(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content, message = FAULTS[name]
    suffix = name.split(":")[0]
    path = tmp_path / f"e.{suffix}"
    if suffix == "bag":
        pytest.importorskip("rosbags")
    monkeypatch.setattr(event_text, "BLOCK", 100)
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        content(path)
    with pytest.raises(DataError, match=message) as error:
        attempt(open_event_file(path, *((WIDTH, HEIGHT) if suffix in ("npz", "npy", "h5", "csv", "txt") else ())))
    assert_one_line(error.value, path)
