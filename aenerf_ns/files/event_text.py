"""Text files of events, as the Event Camera Dataset (Mueggler et al. 2017) and many DAVIS recordings have them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.files.text import first_and_last_row, is_row

_CHUNK_LINES = 1_000_000


class TextEventFile(EventFile):
    """events.txt: t[s] x y p, with polarity 0 or 1."""

    def read_chunks(self) -> Iterator[EventStream]:
        with self.path.open(encoding="ascii", errors="replace") as file:
            lines = 0
            while block := list(islice(file, _CHUNK_LINES)):
                yield self._parse(block, lines)
                lines += len(block)

    def _parse(self, block: list[str], lines_before: int) -> EventStream:
        try:
            table = np.loadtxt(block, dtype=np.float64, ndmin=2)
        except ValueError as error:
            raise DataError(
                self.path, f"after line {lines_before}: {error}", "each line must hold the four numbers t x y p"
            ) from None
        if table.size == 0:
            table = table.reshape(0, 4)
        if table.shape[1] != 4:
            raise DataError(
                self.path, f"its lines have {table.shape[1]} fields", "each line must hold the four numbers t x y p"
            )
        checks = (
            ("time", 0, np.isfinite(table[:, 0]) & (np.abs(table[:, 0]) < 9e9), "times are in seconds"),
            ("x", 1, _is_pixel(table[:, 1], self.width), f"pixel columns are whole numbers below {self.width}"),
            ("y", 2, _is_pixel(table[:, 2], self.height), f"pixel rows are whole numbers below {self.height}"),
            ("polarity", 3, (table[:, 3] == 0) | (table[:, 3] == 1), "polarities are 0 or 1 in this format"),
        )
        for name, column, good, remedy in checks:
            if not good.all():
                row = int(np.argmin(good))
                line = [i for i, text in enumerate(block) if is_row(text.encode("ascii", "replace"))][row]
                raise DataError(self.path, f"line {lines_before + line + 1} has {name} {table[row, column]:g}", remedy)
        return EventStream(
            table[:, 1].astype(np.uint16),
            table[:, 2].astype(np.uint16),
            np.rint(table[:, 0] * 1e9).astype(np.int64),
            (2 * table[:, 3] - 1).astype(np.int8),
            self.width,
            self.height,
            self.path,
        )

    def time_span(self) -> tuple[int, int]:
        self.require()
        first, last = first_and_last_row(self.path)
        if not first or not last:
            raise self.empty_error()
        start, end = (int(self._parse([line], 0).t[0]) for line in (first, last))
        return start, end


def _is_pixel(values: np.ndarray, size: int) -> np.ndarray:
    return (values >= 0) & (values < size) & (values == np.floor(values))
