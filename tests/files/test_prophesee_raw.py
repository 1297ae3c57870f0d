"""RAW files of Prophesee cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.event_file_checks import (
    assert_rejected,
    lapless,
    read,
)
from helpers.event_file_writers import (
    HEADER2,
    HEADER3,
    ROWS,
    WIDTH,
    evt2,
    evt3,
    words,
)

from aenerf_ns.files import prophesee
from aenerf_ns.files.open import open_event_file


def test_a_long_recording_in_evt3_keeps_its_time_over_many_wraps(folder: Path) -> None:
    rng = np.random.default_rng(0)
    # Six hours, with breaks of up to 16 s without a word.
    times = np.cumsum(rng.integers(0, 16_000_000, 2700))
    rows = [(int(x), 3, int(t), 1) for x, t in zip(rng.integers(0, WIDTH, len(times)), times, strict=True)]
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
    monkeypatch.setattr(prophesee, "_BLOCK", block)
    path = folder / "upper.raw"
    words = [0x8001, 0x6FFF, 0x0007, 0x2001, 0x8002, 0x2002, 0x8002, 0x6003, 0x8002, 0x2003]
    path.write_bytes(b"% evt 3.0\n% geometry 64x48\n" + np.array(words, "<u2").tobytes())
    assert (read(open_event_file(path))[:, 2] // 1000).tolist() == [0x1FFF, 0x2000, 0x2003]


MALFORMED: dict[str, tuple[bytes, str]] = {
    "raw with a header alone": (HEADER3, "holds no events"),
    "raw with an endless header": (b"% evt 3.0\n% geometry 64x48", "does not end"),
    "raw with an endless line": (b"% evt 3.0\n% " + b"x" * 100_000, "does not end"),
    "raw without an encoding": (b"% format \n% geometry 64x48\n" + words("<u2", 0x8001), "does not state the encoding"),
    "raw in another encoding": (b"% evt 2.1\n% geometry 64x48\n", "encoded as 2.1"),
    "raw of histograms": (b"% format HISTO3D;width=64;height=48\n", "encoded as HISTO3D"),
    "raw in big endian": (b"% format EVT3;endianness=big;width=64;height=48\n", "encoded as EVT3;endianness=big"),
    "raw of no size": (b"% evt 3.0\n", "does not state the size"),
    "raw of an absurd size": (b"% evt 3.0\n% geometry 999999x999999\n", "999999 x 999999 pixels is too large"),
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
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_are_told_in_one_line(name: str, folder: Path) -> None:
    content, message = MALFORMED[name]
    assert_rejected(folder / name.replace(" ", "_"), content, message)
