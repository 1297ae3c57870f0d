"""Events of columns of any numeric type."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.streams import FUZZ_EXAMPLES
from hypothesis import given, settings
from hypothesis import strategies as st

from aenerf_ns.errors import DataError
from aenerf_ns.files.event_table import events_from_columns

NUMBERS = st.sampled_from([np.int8, np.uint8, np.int16, np.uint32, np.int64, np.uint64, np.float32, np.float64, bool])


@settings(max_examples=5 * FUZZ_EXAMPLES, deadline=None)
@given(st.data())
def test_columns_of_any_type_give_events_or_a_clear_error(data: st.DataObject) -> None:
    size = data.draw(st.integers(0, 4))
    columns = {}
    for name in "xytp":
        kind = data.draw(NUMBERS)
        small = st.integers(-1, 2) if name != "t" else st.integers(0, 100)
        any_bits = st.binary(min_size=8, max_size=8).map(lambda raw, kind=kind: np.frombuffer(raw, kind)[0])
        values = [data.draw(small | any_bits) for _ in range(size)]
        with np.errstate(all="ignore"):
            columns[name] = np.array(values).astype(kind)
    tick, offset = data.draw(st.sampled_from([1, 1_000, 10**9])), data.draw(st.integers(-(2**62), 2**62))
    try:
        events = events_from_columns(columns, width=4, height=3, tick=tick, offset=offset, source="made")
    except DataError:
        return
    for name in "xy":
        np.testing.assert_array_equal(getattr(events, name), columns[name])
    np.testing.assert_array_equal(events.p == 1, columns["p"] == 1)
    if columns["t"].dtype.kind != "f":
        assert events.t.tolist() == [(int(t) + offset) * tick for t in columns["t"]]


@pytest.mark.parametrize("kind", [np.uint8, np.uint64, np.int64, np.float64, bool])
def test_an_offset_beyond_the_limit_leaves_no_good_time(kind: type) -> None:
    one = {name: np.zeros(1, kind if name == "t" else np.uint8) for name in "xytp"}
    with pytest.raises(DataError, match="check the unit of the times"):
        events_from_columns(one, width=4, height=3, tick=10**9, offset=9_223_372_037, source="made")
