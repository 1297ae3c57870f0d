"""Text files of events: the Event Camera Dataset's, and CSV."""

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import pytest
from helpers.event_table_writers import HEIGHT, WIDTH
from helpers.streams import FUZZ_EXAMPLES
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aenerf_ns.errors import DataError
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.files.event_text import TextEventFile, parse_lines
from aenerf_ns.files.open import open_event_file
from aenerf_ns.files.text import TimeUnit


def open_events(path: Path) -> EventFile:
    return TextEventFile(path, WIDTH, HEIGHT)


def written(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    ("rows", "unit", "times"),
    [
        ("1,2,0,1\n3,2,0.000123,0\n3,2,0.25,1\n1,2,1.5,0\n", None, [0, 123_000, 250_000_000, 1_500_000_000]),
        ("1,2,1600000000123456789,1\n", "ns", [1_600_000_000_123_456_789]),
        ("1,2,1600000000.000000001,1\n", None, [1_600_000_000_000_000_001]),
    ],
)
def test_times_in_csv_are_exact(rows: str, unit: TimeUnit | None, times: list[int], tmp_path: Path) -> None:
    file = open_event_file(written(tmp_path / "EVENTS.CSV", f"x,y,t,p\n{rows}"), WIDTH, HEIGHT, time_unit=unit)
    (events,) = file.chunks()
    assert events.t.tolist() == times
    assert file.time_span() == (times[0], times[-1])


def test_skip_blanks_comments_and_empty_lines(tmp_path: Path) -> None:
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
    assert open_events(written(path, "\ufeff5 2 3 1\n")).time_span() == (5_000, 5_000)


@pytest.mark.parametrize("end", ["\n" * 200_000, f"#{'x' * 5_000}\n", f"\n#{'x' * 60_000}" * 3])
def test_what_follows_the_last_event_may_be_long(end: str, tmp_path: Path) -> None:
    file = open_events(written(tmp_path / "events.txt", f"1 2 3 1\n5 2 3 1\n{end}"))
    assert file.time_span() == (1_000, 5_000)


def test_real_recording_is_exact(slider_depth: Path) -> None:
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


@pytest.mark.parametrize("text", ["x,y,t,p\n", "96 72\n", "# t x y p\n"])
@pytest.mark.parametrize("suffix", ["txt", "csv"])
def test_headers_alone_are_no_events(suffix: str, text: str, tmp_path: Path) -> None:
    file = open_event_file(written(tmp_path / f"empty.{suffix}", text), 96, 72)
    for look in (lambda file: file.time_span(), lambda file: list(file.chunks())):
        with pytest.raises(DataError, match="the file holds no events"):
            look(file)


PLAIN = [(31, 62, 500_004, 0), (58, 17, 500_010, 1), (56, 21, 500_011, 0)]
SPELLINGS = {
    "bom.csv": "\ufeffx,y,t,p\n" + "".join(f"{x},{y},{t},{p}\n" for x, y, t, p in PLAIN),
    "bom.txt": "\ufeff" + "".join(f"{t} {x} {y} {p}\n" for x, y, t, p in PLAIN),
    "metavision.csv": "".join(f"{x},{y},{p},{t}\n" for x, y, t, p in PLAIN),
    "format.csv": "% geometry 96x72\n% format CSV\n" + "".join(f"{x},{y},{p},{t}\n" for x, y, t, p in PLAIN),
    "numbered.csv": ",x,y,t,p\n" + "".join(f"{i},{x},{y},{t},{p}\n" for i, (x, y, t, p) in enumerate(PLAIN)),
    "geometry.csv": "%geometry:96,72\n" + "".join(f"{x},{y},{p},{t}\n" for x, y, t, p in PLAIN),
    "e2vid.txt": "96 72\n" + "".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for x, y, t, p in PLAIN),
    "plus_minus.txt": "".join(f"{t / 1e6:.6f} {x} {y} {2 * p - 1}\n" for x, y, t, p in PLAIN),
    "microseconds.txt": "".join(f"{t} {x} {y} {p}\n" for x, y, t, p in PLAIN),
    "commas.txt": "".join(f"{t / 1e6:.6f},{x},{y},{p}\n" for x, y, t, p in PLAIN),
    "remark.txt": "".join(f"{t} {x} {y} {p} # first, or later\n" for x, y, t, p in PLAIN),
    "named.txt": "timestamp x y polarity\n" + "".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for x, y, t, p in PLAIN),
    "xytp.txt": "".join(f"{x} {y} {t} {p}\n" for x, y, t, p in PLAIN),
    "comment.txt": "# t y x p\n" + "".join(f"{t} {y} {x} {p}\n" for x, y, t, p in PLAIN),
    "label.txt": "# events: t[ns] y x p\n" + "".join(f"{t}000 {y} {x} {p}\n" for x, y, t, p in PLAIN),
    "unit_in_comment.txt": "% t [ns] x y p\n" + "".join(f"{t}000 {x} {y} {p}\n" for x, y, t, p in PLAIN),
    "unit_in_comment.csv": "# t[ns],x,y,p\n" + "".join(f"{t}000,{x},{y},{p}\n" for x, y, t, p in PLAIN),
    "unit.csv": "timestamp [ms],x,y,polarity\n" + "".join(f"{t / 1e3},{x},{y},{p}\n" for x, y, t, p in PLAIN),
    "unit_in_parentheses.csv": "t (ms),x,y,p\n" + "".join(f"{t / 1e3},{x},{y},{p}\n" for x, y, t, p in PLAIN),
    "unit_in_name.csv": "time_us,x,y,p\n" + "".join(f"{t}.0,{x},{y},{p}\n" for x, y, t, p in PLAIN),
    "two_times.csv": "timestamp_host,t,x,y,p\n" + "".join(f"{-t},{t},{x},{y},{p}\n" for x, y, t, p in PLAIN),
    "aliases.csv": "polarity,x,y,ts\n" + "".join(f"{p},{x},{y},{t}\n" for x, y, t, p in PLAIN),
}


@pytest.mark.parametrize("name", SPELLINGS)
def test_read_the_spellings_that_are_unambiguous(name: str, tmp_path: Path) -> None:
    file = open_event_file(written(tmp_path / name, SPELLINGS[name]), 96, 72)
    (events,) = file.chunks()
    expected = [(x, y, 1000 * t, 2 * p - 1) for x, y, t, p in PLAIN]
    assert list(zip(events.x, events.y, events.t, events.p, strict=True)) == expected
    assert file.time_span() == (expected[0][2], expected[-1][2])


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("name", ["format.csv", "geometry.csv", "e2vid.txt"])
def test_take_the_size_that_the_file_states(name: str, mark: str, tmp_path: Path) -> None:
    path = written(tmp_path / name, mark + SPELLINGS[name])
    file = open_event_file(path)
    assert (file.width, file.height) == (96, 72)
    with pytest.raises(DataError, match="its sensor has 96 x 72 pixels, but 346 x 260 were given"):
        open_event_file(path, 346, 260)


def test_refuse_another_unit_than_that_in_the_names(tmp_path: Path) -> None:
    path = written(tmp_path / "events.txt", SPELLINGS["unit_in_comment.txt"])
    assert open_event_file(path, 96, 72, time_unit="ns").assumed_unit() is None
    with pytest.raises(DataError, match="it states its time unit, 'ns', but us was given; leave it out"):
        next(open_event_file(path, 96, 72, time_unit="us").chunks())
