"""Decode Prophesee's event encodings EVT 2.0 and EVT 3.0.

https://docs.prophesee.ai/stable/data/encoding_formats/evt2.html and evt3.html

This module imports numba: import it only where events are read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.files.event_reader import CHUNK, Columns
from aenerf_ns.files.left_out import LeftOut

TIME_HIGH = 0x8
"""The kind of word that holds the upper bits of a time, in both encodings."""

# Events that one word can hold.
_MAX_PER_WORD = 12

# Upper bits of a time that jump are damaged if one of so many that follow goes on from those before them, and is
# confirmed by so many more.
_RETURNING, _CONFIRMING = 8, 3

# The state of a decoder from one word to the next.
_HIGH, _LOW, _ROW, _BASE, _POLARITY, _OFFSET = range(6)
_UNKNOWN = np.iinfo(np.int64).min

_EVT2_HIGH_BITS = 28
_EVT3_HIGH_BITS = 12
# Cameras of Lucid fill packets with this word.
_PADDING = 0x9999
# Upper bits of a time that are up to this many steps of 4.096 ms below the last ones go back in time, and the file is
# rejected. Any other upper bits are ahead, by up to 16.7 s.
_EVT3_BEHIND = 16


def initial_state(offset: int = 0) -> NDArray[np.int64]:
    """Return the state of a decoder that has seen nothing, and adds an offset in nanoseconds to every time."""
    state = np.full(6, _UNKNOWN, dtype=np.int64)
    state[_OFFSET] = offset
    return state


@numba.njit(cache=True)
def _decode_evt2(words, position, x, y, t, p, n, state):
    high, offset = state[_HIGH], state[_OFFSET]
    mask = (1 << _EVT2_HIGH_BITS) - 1
    half = 1 << (_EVT2_HIGH_BITS - 1)
    while position < words.shape[0] and n + _MAX_PER_WORD <= x.shape[0]:
        word = np.int64(words[position])
        kind = word >> 28
        if kind <= 0x1:
            if high != _UNKNOWN:
                x[n] = (word >> 11) & 0x7FF
                y[n] = word & 0x7FF
                t[n] = ((high << 6) | ((word >> 22) & 0x3F)) * 1000 + offset
                p[n] = 2 * kind - 1
                n += 1
        elif kind == 0x8:
            new = word & mask
            # Take the nearest time with these bits, because the 34 bits of a time wrap every 4.8 h.
            high = new if high == _UNKNOWN else high + ((new - high + half) & mask) - half
        elif kind != 0xA and kind != 0xE and kind != 0xF:
            break
        position += 1
    state[_HIGH] = high
    return position, n


@numba.njit(cache=True)
def _decode_evt3(words, position, x, y, t, p, n, state):
    high, low, row = state[_HIGH], state[_LOW], state[_ROW]
    base, polarity, offset = state[_BASE], state[_POLARITY], state[_OFFSET]
    mask = (1 << _EVT3_HIGH_BITS) - 1
    time = ((high << 12) | low) * 1000 + offset
    ready = high != _UNKNOWN and low != _UNKNOWN and row != _UNKNOWN
    while position < words.shape[0] and n + _MAX_PER_WORD <= x.shape[0]:
        word = np.int64(words[position])
        kind = word >> 12
        value = word & 0xFFF
        if kind == 0x2:  # an event
            if ready:
                x[n] = value & 0x7FF
                y[n] = row
                t[n] = time
                p[n] = 1 if value & 0x800 else -1
                n += 1
        elif kind == 0x0:  # the row of what follows
            row = value & 0x7FF
            ready = high != _UNKNOWN and low != _UNKNOWN
        elif kind == 0x6:  # lower 12 bits of the time
            low = value
            time = ((high << 12) | low) * 1000 + offset
            ready = high != _UNKNOWN and row != _UNKNOWN
        elif kind == 0x8:  # bits 12 to 23 of the time, repeated every 16 us
            if high == _UNKNOWN:
                high = value
                low = _UNKNOWN
            elif value != high & mask:
                high += ((value - high + _EVT3_BEHIND) & mask) - _EVT3_BEHIND
                time = (high << 12) * 1000 + offset
                if low != _UNKNOWN:
                    # Only until the lower bits follow.
                    low = 0
        elif kind == 0x3:  # where the following vectors begin
            base = value & 0x7FF
            polarity = 1 if value & 0x800 else -1
        elif kind == 0x4 or kind == 0x5:  # 12 or 8 neighboring pixels of a row
            length = 12 if kind == 0x4 else 8
            if ready and base != _UNKNOWN:
                for bit in range(length):
                    if (value >> bit) & 1:
                        # Columns beyond any sensor must not wrap to small numbers.
                        x[n] = min(base + bit, 0xFFFF)
                        y[n] = row
                        t[n] = time
                        p[n] = polarity
                        n += 1
                base += length
        elif kind != 0x7 and kind != 0xA and kind != 0xE and kind != 0xF and word != _PADDING:
            break
        position += 1
    state[_HIGH], state[_LOW], state[_ROW], state[_BASE], state[_POLARITY] = high, low, row, base, polarity
    return position, n


@dataclass(frozen=True)
class Encoding:
    """An encoding of events in words of a type.

    ``decode`` decodes words from a position on until they end, the columns are full or a word is unknown. It returns
    the position and the number of events in the columns.
    """

    name: str
    dtype: np.dtype
    decode: Callable
    high_bits: int
    """Upper bits of a time that a word holds."""
    max_steps: int
    """Steps of the upper bits in 65 ms: cameras send them far more often."""

    def kinds(self, words: NDArray) -> NDArray:
        """Return the upper 4 bits of words, which tell their kinds."""
        return words >> 8 * self.dtype.itemsize - 4


# Words without events (triggers, and words of vendors) are skipped. Undocumented kinds of words are errors.
EVT2 = Encoding("EVT 2.0", np.dtype("<u4"), _decode_evt2, _EVT2_HIGH_BITS, 1 << 10)
EVT3 = Encoding("EVT 3.0", np.dtype("<u2"), _decode_evt3, _EVT3_HIGH_BITS, 1 << 4)


_JUMPS = "jumps of the camera's time by more than 65 ms, where events may be missing or its clock may have restarted"


def without_damaged_times(blocks: Iterable[NDArray], encoding: Encoding, left_out: LeftOut) -> Iterator[NDArray]:
    """Blank out upper bits of a time that jump and come back within a few words, and the events that they would date.

    Such words would move all later events by up to a lap of the time. The very last upper bits are blanked out as well
    if they jump, because none confirm them, and the first ones if the next two contradict them. Jumps that stay are
    counted.

    Args:
        blocks: (N,) words in pieces, which may end anywhere.
        encoding: of the words.
        left_out: takes the events that are blanked out, and the jumps that stay.
    """
    held, last = np.zeros(0, encoding.dtype), None
    num_before = 0
    for block in chain(blocks, (None,)):
        words = held if block is None else np.concatenate([held, block])
        where = np.flatnonzero(encoding.kinds(words) == TIME_HIGH)
        # Upper bits wait for those that confirm them.
        num_judged = len(where) if block is None else max(len(where) - _RETURNING - _CONFIRMING, 0)
        end = int(where[num_judged]) if num_judged < len(where) else len(words)
        if num_judged:
            high = (words[where] & (1 << encoding.high_bits) - 1).astype(np.int64)
            last = _first_time_high(high, encoding) if last is None else last
            damaged = [index for index in _damaged_times(high, last, encoding, block is None) if index < num_judged]
            for index in damaged:
                part = words[where[index] : where[index + 1] if index + 1 < len(where) else None]
                number = _blank_out(part, encoding)
                if number:
                    left_out.add_number("after a damaged time", number, f"at word {num_before + where[index]}")
            kept = np.delete(np.arange(num_judged), damaged)
            steps = np.diff(high[kept], prepend=last) & (1 << encoding.high_bits) - 1
            left_out.add_missing(_JUMPS, int(_jumps(steps, encoding).sum()))
            last = int(high[kept[-1]]) if len(kept) else last
        yield words[:end]
        held = words[end:]
        num_before += end


def _goes_on(before: NDArray | int, after: NDArray, encoding: Encoding) -> NDArray[np.bool_]:
    """Return whether upper bits of a time come at most 65 ms after others."""
    return (after - before) & (1 << encoding.high_bits) - 1 <= encoding.max_steps


def _jumps(steps: NDArray[np.int64], encoding: Encoding) -> NDArray[np.bool_]:
    """Return which steps are jumps. A few steps back leave events out of order, and move none by a lap."""
    return np.minimum(steps, (1 << encoding.high_bits) - steps) > encoding.max_steps


def _first_time_high(high: NDArray[np.int64], encoding: Encoding) -> int:
    """Return the first of (N,) upper bits, or the second if it and the third fit each other and not the first."""
    contradicted = len(high) > 2 and not _goes_on(high[0], high[1:3], encoding).any()
    return int(high[int(contradicted and bool(_goes_on(high[1], high[2], encoding)))])


def _damaged_times(high: NDArray[np.int64], last: int, encoding: Encoding, is_end: bool) -> list[int]:
    """Return which of (N,) upper bits are damaged, from the last good ones before them."""
    mask = (1 << encoding.high_bits) - 1
    before = np.concatenate([[last], high[:-1]])
    steps, steps_after = (high - before) & mask, (high[1:] - before[:-1]) & mask
    # One alone may differ from its neighbors by little.
    suspicious = np.append((steps_after <= encoding.max_steps) & (steps[:-1] > steps_after), False)
    jumps = _jumps(steps, encoding)
    damaged: list[int] = []
    for index in np.flatnonzero(suspicious | jumps).tolist():
        # The first upper bits after damaged ones jump back, and are right.
        if damaged and damaged[-1] >= index - 1:
            continue
        if suspicious[index]:
            damaged.append(index)
            continue
        back = np.flatnonzero(_goes_on(int(before[index]), high[index + 1 : index + 1 + _RETURNING], encoding))
        for end in (index + 1 + back).tolist():
            if _goes_on(int(high[end]), high[end + 1 : end + 1 + _CONFIRMING], encoding).all():
                damaged += range(index, end)
                break
        else:
            if is_end and index == len(high) - 1:
                damaged.append(index)
    return damaged


def _blank_out(words: NDArray, encoding: Encoding) -> int:
    """Make words that hold a time or events such that hold nothing, and return the number of the events."""
    kinds = encoding.kinds(words)
    if encoding is EVT2:
        has_events = kinds <= 0x1
        number = int(has_events.sum())
    else:
        has_events = (kinds == 0x2) | (kinds == 0x4) | (kinds == 0x5)
        vectors = words[kinds == 0x4] & 0xFFF, words[kinds == 0x5] & 0xFF
        number = int((kinds == 0x2).sum()) + sum(int(word).bit_count() for part in vectors for word in part)
    words[has_events | (kinds == TIME_HIGH)] = 0xF << 8 * encoding.dtype.itemsize - 4
    return number


def decode_words(
    blocks: Iterable[NDArray], encoding: Encoding, state: NDArray[np.int64], source: Path
) -> Iterator[Columns]:
    """Decode words to events. Events before the first complete time cannot be dated and are left out.

    Args:
        blocks: (N,) words in pieces, which may end anywhere.
        encoding: the encoding of the words.
        state: from :func:`initial_state`.
        source: the file, for messages.

    Yields:
        Columns x, y, t (nanoseconds) and p (±1) of about a million events each. Their order in time is not checked.

    Raises:
        DataError: a word is of a kind that the encoding does not have.
    """
    num_before = n = 0
    columns = _empty_columns()
    for block in blocks:
        position = 0
        while True:
            position, n = encoding.decode(block, position, *columns, n, state)
            if position == len(block):
                break
            if n + _MAX_PER_WORD <= CHUNK:
                problem = f"word {num_before + position} is {block[position]:#x}, which {encoding.name} does not have"
                raise DataError(source, problem, "the file is damaged or in another encoding: copy or record it again")
            yield tuple(column[:n] for column in columns)  # type: ignore[misc]
            columns, n = _empty_columns(), 0
        num_before += len(block)
    if n:
        yield tuple(column[:n] for column in columns)  # type: ignore[misc]


def _empty_columns() -> Columns:
    x, y = np.empty((2, CHUNK), np.uint16)
    return x, y, np.empty(CHUNK, np.int64), np.empty(CHUNK, np.int8)
