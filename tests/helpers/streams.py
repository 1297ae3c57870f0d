"""Small event streams, and how many examples random tests draw."""

from __future__ import annotations

import os

import numpy as np

from aenerf_ns.events.stream import EventStream

FUZZ_EXAMPLES = int(os.environ.get("AENERF_FUZZ_EXAMPLES", "60"))
"""Examples of each test that feeds readers with damaged and random input; many more when they are set to."""


def make_stream(rows: list[tuple[int, int, int, int]], width: int = 4, height: int = 3) -> EventStream:
    """A stream of (x, y, t, p) rows."""
    x, y, t, p = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    return EventStream(
        x.astype(np.uint16), y.astype(np.uint16), t.astype(np.int64), p.astype(np.int8), width, height, "made"
    )
