"""Read event files and check that malformed ones raise one clear line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

from aenerf_ns.errors import DataError
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.files.open import open_event_file
from helpers.event_file_writers import Rows

_VENDOR_FILES = Path(__file__).parents[3] / "shared" / "data" / "vendor_formats"


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


def attempt(file: EventFile) -> None:
    """Read all there is to read, as `aenerf convert` would."""
    file.count()
    start, end = file.time_span()
    chunks = list(file.chunks())
    assert (start, end) == (chunks[0].t[0], chunks[-1].t[-1])


def assert_one_line(error: DataError, path: Path) -> None:
    assert str(error).startswith(f"{path}: ")
    assert len(str(error)) < 400


# Ways to damage a file. Half of the places lie in the first sixteenth of its length: headers are where the sizes are.
EDITS = st.lists(
    st.tuples(
        st.sampled_from(["set", "flip", "cut", "insert", "repeat", "number", "long number"]),
        st.floats(0, 1, exclude_max=True).map(lambda fraction: fraction**4),
        st.integers(0, 255) | st.sampled_from([2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**64 - 1]),
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
            data[place:place] = value.to_bytes(8, "little")
        elif kind == "repeat":
            data[place:place] = data[place : place + value % 5000]
        elif "number" in kind:
            size = 8 if kind == "long number" else 4
            data[place : place + size] = value.to_bytes(8, "little")[:size]
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
