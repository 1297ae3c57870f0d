"""Text files of events: the Event Camera Dataset's, and CSV."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import pytest
from helpers.event_table_writers import HEIGHT, WIDTH, Columns, N, lengths_of_read_pieces, made_columns, write_csv
from helpers.streams import FUZZ_EXAMPLES
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventFile
from aenerf_ns.files import event_text
from aenerf_ns.files.event_text import CsvEventFile, TextEventFile, parse_lines
from aenerf_ns.files.open import open_event_file
from aenerf_ns.files.text import TimeUnit


def open_events(path: Path) -> EventFile:
    return (CsvEventFile if path.suffix == ".csv" else TextEventFile)(path, WIDTH, HEIGHT)


def written(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


LAYOUTS: dict[str, tuple[str, Callable[[Path, Columns], object], int]] = {
    "CSV": ("events.csv", write_csv, 0),
    # The spacing of float64 seconds since 1970 is 238 ns.
    "CSV in seconds": ("events.csv", lambda path, columns: write_csv(path, {**columns, "t": columns["t"] * 1e-6}), 500),
    "text": ("events.txt", lambda path, columns: write_text(path, columns, "{s}.{us:06d} {x} {y} {p}\n"), 0),
    "text with an exponent": ("events.txt", lambda path, c: write_text(path, c, "{t}.00e-6  {x}.0\t{y}e0 {p}\r\n"), 0),
}


def write_text(path: Path, columns: Columns, line: str) -> None:
    rows = zip(*(columns[name].tolist() for name in "xytp"), strict=True)
    text = "".join(line.format(x=x, y=y, t=t, s=t // 10**6, us=t % 10**6, p=p) for x, y, t, p in rows)
    written(path, f"# made\n{text}")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_events_it_was_written_with(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_text, "BLOCK", 1000)
    name, write, error = LAYOUTS[layout]
    lengths = lengths_of_read_pieces(tmp_path / name, write, open_events, error)
    assert 5 < len(lengths) < 20


@pytest.mark.parametrize(("unit", "end"), [(None, 299_000), ("ns", 299), ("s", 299 * 10**9)])
def test_the_unit_of_times_may_be_given(unit: TimeUnit | None, end: int, tmp_path: Path) -> None:
    write_csv(tmp_path / "events.csv", {**made_columns(), "t": np.arange(N)})
    assert open_event_file(tmp_path / "events.csv", WIDTH, HEIGHT, time_unit=unit).time_span() == (0, end)


@pytest.mark.parametrize("name", ["events.csv", "EVENTS.CSV"])
def test_decimals_behind_a_whole_number_in_csv_are_kept(tmp_path: Path, name: str) -> None:
    path = written(tmp_path / name, "x,y,t,p\n1,2,0,1\n3,2,0.000123,0\n3,2,0.25,1\n1,2,1.5,0\n")
    file = open_event_file(path, WIDTH, HEIGHT)
    (events,) = file.chunks()
    assert events.t.tolist() == [0, 123_000, 250_000_000, 1_500_000_000]
    assert file.time_span() == (0, 1_500_000_000)


def test_whole_numbers_in_csv_are_exact_beyond_float64(tmp_path: Path) -> None:
    path = written(tmp_path / "events.csv", "x,y,t,p\n1,2,1600000000123456789,1\n")
    assert CsvEventFile(path, WIDTH, HEIGHT, "ns").time_span()[0] == 1_600_000_000_123_456_789


def test_seconds_since_1970_keep_their_nanoseconds(tmp_path: Path) -> None:
    times = [1_600_000_000_000_000_001 + 3 * i for i in range(50)]
    seconds = [f"{t // 10**9}.{t % 10**9:09d}" for t in times]
    path = written(tmp_path / "events.txt", "".join(f"{t} 1 2 1\n" for t in seconds))
    (events,) = open_events(path).chunks()
    assert events.t.tolist() == times
    path = written(tmp_path / "events.csv", "x,y,t,p\n" + "".join(f"1,2,{t},1\n" for t in seconds))
    (events,) = open_events(path).chunks()
    assert events.t.tolist() == times


def test_blanks_comments_and_empty_lines_are_passed_over(tmp_path: Path) -> None:
    text = "# t x y p\n\n \t0.5\t1   2 1 # one\r\n   # none\n\r\n-0.25e+1 +3 4. 0"
    path = written(tmp_path / "events.txt", text.replace("0.5", "-3.5"))
    (events,) = open_events(path).chunks()
    assert np.stack([events.x, events.y, events.t, events.p], -1).tolist() == [
        [1, 2, -3_500_000_000, 1],
        [3, 4, -2_500_000_000, -1],
    ]
    path = written(tmp_path / "events.csv", '"P" , x,\ty,other,t,x\n1 , 3,4,-7.5,  8,9 # the second x is another\n')
    (events,) = open_events(path).chunks()
    assert (events.x[0], events.y[0], events.t[0], events.p[0]) == (3, 4, 8000, 1)


def test_a_real_recording_is_read_to_the_nanosecond(slider_depth: Path) -> None:
    events = next(TextEventFile(slider_depth / "events.txt", 240, 180).chunks())
    lines = (slider_depth / "events.txt").read_text().splitlines()[: len(events)]
    assert events.t.tolist() == [int(Decimal(line.split()[0]) * 10**9) for line in lines]


@settings(max_examples=5 * FUZZ_EXAMPLES, deadline=None)
@given(
    st.from_regex(r"[+-]?([0-9]{0,12}|[0-9]{17,30})(\.[0-9]{0,25})?([eE][+-]?[0-9]{1,3})?", fullmatch=True),
    st.sampled_from([b" ", b","]),
)
@example("930000000000000000.931", b" ")
def test_numbers_are_exact(number: str, separator: bytes) -> None:
    line = separator.join([b"7", number.encode(), b"8"]) + b"\n"
    whole, fraction, fault = parse_lines(line, separator == b",", [-1, 0, 1])
    try:
        expected = Decimal(number)
    except InvalidOperation:
        assert fault == 0
        return
    assert fault is None
    assert whole[1, 0] == 8
    if abs(expected) < 9 * 10**18:
        assert whole[0, 0] == int(expected)
        # Nineteen digits of a number are kept where int64 holds them, as it does up to 922..., and eighteen elsewhere.
        spacing = max(1e-16, float(abs(expected)) / 9.2e17)
        assert abs(Decimal(fraction[0, 0]) - expected % 1) < spacing
    else:
        assert abs(int(whole[0, 0])) >= 9 * 10**18


@settings(max_examples=5 * FUZZ_EXAMPLES, deadline=None)
@given(
    st.text(alphabet='xytp,0123456789.-+e#\n" nai²\0\r', max_size=80),
    st.sampled_from(["", "x,y,t,p\n"]),
    st.sampled_from(["txt", "csv"]),
)
def test_no_text_crashes_the_reader(
    tmp_path_factory: pytest.TempPathFactory, text: str, header: str, suffix: str
) -> None:
    path = tmp_path_factory.getbasetemp() / f"fuzzed.{suffix}"
    path.write_text(header + text, encoding="utf-8")
    for read in (lambda events: list(events.chunks()), lambda events: events.time_span()):
        try:
            read(open_events(path))
        except DataError as error:
            assert "\n" not in str(error)  # noqa: PT017
