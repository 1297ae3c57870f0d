"""DAT files of Prophesee's tools and datasets."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.event_file_checks import (
    assert_rejected,
)
from helpers.event_file_writers import (
    ROWS,
    dat,
    words,
)

MALFORMED: dict[str, tuple[bytes, str]] = {
    "dat cut": (dat(ROWS)[:-1], "ends within a record of 8 bytes"),
    "dat without records": (dat([]), "holds no events"),
    "dat without a type": (dat([])[:-2], "type and size none"),
    "dat of triggers": (dat(ROWS).replace(b"\x0c\x08", b"\x0e\x08"), "type and size 0e 08"),
    "dat of version 1": (dat(ROWS).replace(b"Version 2", b"Version 1"), "its version is 1"),
    "dat without a version": (dat(ROWS).replace(b"% Version 2\n", b""), "its version is none"),
    "dat beside the sensor": (dat([(64, 1, 0, 1)]), "x = 64 on a sensor of width 64"),
    "dat of polarity 2": (dat([])[:] + words("<u4", 0, 2 << 28), "has polarity 3"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_are_told_in_one_line(name: str, folder: Path) -> None:
    content, message = MALFORMED[name]
    assert_rejected(folder / name.replace(" ", "_"), content, message)
