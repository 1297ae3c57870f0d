"""AEDAT4 files of DV."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.event_file_checks import (
    assert_rejected,
    read,
    table,
)
from helpers.event_file_writers import (
    ROWS,
    aedat4_file,
    sized,
)

from aenerf_ns.errors import DataError
from aenerf_ns.files.open import open_event_file


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


MALFORMED: dict[str, tuple[bytes, str]] = {
    "aedat of version 2": (b"#!AER-DAT2.0\r\n# events", "does not begin as an AEDAT4 file"),
    "aedat4 with its magic alone": (b"#!AER-DAT4.0\r\n", "not a readable AEDAT4 file"),
    "aedat4 cut in its header": (aedat4_file(ROWS)[:100], "not a readable AEDAT4 file"),
    "aedat4 with a header of zeros": (b"#!AER-DAT4.0\r\n" + sized(bytes(64)), "not a readable AEDAT4 file"),
    "aedat4 without events": (aedat4_file(ROWS, streams={0: "FRME"}), "no stream holds events"),
    "aedat4 of no number": (
        aedat4_file(ROWS).replace(b'node name="0"', b'node name="?"'),
        "not a readable AEDAT4 file",
    ),
    "aedat4 of an unknown compression": (aedat4_file(ROWS, compression=9), "compression is number 9"),
    "aedat4 of another compression": (aedat4_file(ROWS, compression=1), ""),
    "aedat4 cut in a packet": (aedat4_file(ROWS)[:-20], "ends within the packet"),
    "aedat4 cut in a packet's head": (aedat4_file(ROWS)[:-10], "ends within the packet"),
    "aedat4 that ends before its table": (aedat4_file(ROWS, with_table=True)[:-300], "ends before its table"),
    "aedat4 of other packets": (aedat4_file(ROWS).replace(b"EVTS\x06", b"FRME\x06"), "does not hold events"),
    "aedat4 beside the sensor": (aedat4_file([(64, 1, 0, 1)]), "x = 64 on a sensor of width 64"),
    "aedat4 at an absurd time": (aedat4_file([(1, 1, 1 << 62, 1)]), "more than 292 years"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_are_told_in_one_line(name: str, folder: Path) -> None:
    content, message = MALFORMED[name]
    assert_rejected(folder / name.replace(" ", "_"), content, message)
