"""AEDAT4 files of DV, and RAW files of Prophesee's cameras."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.event_file_checks import read, table
from helpers.event_file_writers import aedat4_file

from aenerf_ns.errors import DataError
from aenerf_ns.files import prophesee
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


def test_choose_a_stream_of_aedat4(folder: Path) -> None:
    path = folder / "stereo.aedat4"
    path.write_bytes(aedat4_file([(1, 2, 3, 1)], streams={0: "EVTS", 4: "EVTS"}))
    with pytest.raises(DataError, match="several streams hold events; choose one of 0, 4"):
        open_event_file(path)
    assert len(read(open_event_file(path, topic="0"))) == 1
    with pytest.raises(DataError, match="holds no events"):
        read(open_event_file(path, topic="4"))


@pytest.mark.parametrize("line", [b"", b"%\n", b"%\r\n"])
def test_skip_empty_lines_of_the_header_and_words_before_the_first_time(line: bytes, folder: Path) -> None:
    path = folder / "late.raw"
    words = [0x2005, 0x0007, 0x2006, 0x8001, 0x2007, 0x3008, 0x4FFF, 0x6002, 0x2009]
    path.write_bytes(b"% evt 3.0\n" + line + b"% geometry 64x48\n" + np.array(words, "<u2").tobytes())
    np.testing.assert_array_equal(read(open_event_file(path)), [[9, 7, (0x1002) * 1000, -1]])


@pytest.mark.parametrize("block", [1, 100])
def test_upper_bits_of_time_take_effect_alone(block: int, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prophesee, "BLOCK", block)
    path = folder / "upper.raw"
    words = [0x8001, 0x6FFF, 0x0007, 0x2001, 0x8002, 0x2002, 0x8002, 0x6003, 0x8002, 0x2003]
    path.write_bytes(b"% evt 3.0\n% geometry 64x48\n" + np.array(words, "<u2").tobytes())
    assert (read(open_event_file(path))[:, 2] // 1000).tolist() == [0x1FFF, 0x2000, 0x2003]
