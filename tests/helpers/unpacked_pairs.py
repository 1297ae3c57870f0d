"""The pairs of a table of pairs, one by one."""

from __future__ import annotations

from aenerf_ns.events.pair_store import EventPairs


def unpacked(pairs: EventPairs) -> list[tuple[int, ...]]:
    """(x, y, previous time, time, positives, negatives, reach) of every pair, in the order of the rows."""
    assert len(pairs.rows) % 16 == 0
    found, positive, negative, heads = [], 0, 0, 0
    for row, (time, number) in enumerate(pairs.rows.tolist()):
        pixel, reach, low = number >> 40, number >> 32 & 255, number & 0xFFFFFFFF
        if reach:
            # In eighths of an event, with what the pixel is blind to after it: no whole number of events.
            sums = (low - positive) & 0xFFFF, ((low >> 16) - negative) & 0xFFFF
            counts = tuple(int(other == 0) if own % 8 else own // 8 for own, other in (sums, sums[::-1]))
            positive, negative = low & 0xFFFF, low >> 16
            place = (pixel % pairs.width, pixel // pairs.width)
            found.append((*place, int(pairs.rows[row - 1, 0]), time, *counts, reach))
        else:
            positive = negative = 0
            if (time, number) != (0, 0) or row == 0:
                assert low == heads
                heads += 1
    assert len(found) == len(pairs)
    return found
