"""A few malformed events, which can be left out: they are counted and named, and the others are read as they are."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tyro
from helpers.bag_writers import ARRAY, array_message, write_bag
from helpers.event_file_checks import read
from helpers.event_file_writers import (
    HEADER2,
    HEADER3,
    HEIGHT,
    WIDTH,
    Rows,
    aedat4_file,
    dat,
    evt2,
    evt3,
    evt3_of,
    words,
)
from helpers.event_table_writers import Columns, write_csv, write_eds, write_text
from helpers.own_recordings import random_events, write_calibration, write_poses

from aenerf_ns.cli.convert import Convert
from aenerf_ns.dataparsers.enerf_esim import EsimEventFolder
from aenerf_ns.errors import DataError
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.files.open import open_event_file

ROWS: Rows = [(i % WIDTH, i % HEIGHT, 100_000 + 10 * i, 1 - 2 * (i % 2)) for i in range(5000)]


def as_bag(path: Path, rows: Rows) -> None:
    messages = [(i, array_message(rows[i : i + 100])) for i in range(0, len(rows), 100)]
    write_bag(path, {"/events": (ARRAY, messages)})


def in_columns(write: Callable[[Path, Columns], object]) -> Callable[[Path, Rows], object]:
    return lambda path, rows: write(path, dict(zip("xytp", np.array(rows).T, strict=True)))


def in_bytes(encode: Callable[[Rows], bytes]) -> Callable[[Path, Rows], None]:
    return lambda path, rows: path.write_bytes(encode(rows)) and None


WRITERS = {
    ".h5": in_columns(write_eds),
    ".npz": in_columns(lambda path, columns: np.savez(path, **columns)),
    ".txt": in_columns(lambda path, columns: write_text(path, columns, "{t} {x} {y} {p}\n")),
    ".csv": in_columns(write_csv),
    ".bag": as_bag,
    ".dat": in_bytes(dat),
    ".aedat4": in_bytes(aedat4_file),
    ".evt2.raw": in_bytes(evt2),
    ".evt3.raw": in_bytes(evt3),
}


def opened(path: Path, drop_malformed: bool = False) -> EventFile:
    states_size = path.suffix in (".dat", ".aedat4", ".raw", ".bag")
    file = open_event_file(path) if states_size else open_event_file(path, WIDTH, HEIGHT)
    file.drop_malformed = drop_malformed
    return file


@pytest.mark.parametrize("suffix", WRITERS)
def test_leave_out_a_few_malformed_events(suffix: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / f"faults{suffix}"
    early, late, outside = (7, 7, 100_010, 1), (7, 7, 149_000, 1), (1, HEIGHT + 3, 120_000, 1)
    rows = [*ROWS[:1000], early, *ROWS[1000:2000], outside, *ROWS[2000:4000], late, *ROWS[4000:]]
    if suffix == ".evt2.raw":
        # Its upper bits cannot go back and forth without looking damaged.
        rows.remove(late)
    WRITERS[suffix](path, rows)
    with pytest.raises(DataError, match="drop-malformed"):
        read(opened(path))
    file = opened(path, drop_malformed=True)
    np.testing.assert_array_equal(read(file)[:, 2], [t * 1000 for _, _, t, _ in ROWS])
    assert file.time_span() == (ROWS[0][2] * 1000, ROWS[-1][2] * 1000)
    said = capsys.readouterr().out
    assert "out of order (the first at 100010000 ns)" in said
    assert f"y = {HEIGHT + 3}" in said or "impossible y (the first " in said


@pytest.mark.parametrize("suffix", [".dat", ".aedat4", ".evt2.raw", ".evt3.raw", ".txt", ".csv"])
def test_leave_out_the_end_of_an_interrupted_recording(
    suffix: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / f"cut{suffix}"
    WRITERS[suffix](path, ROWS)
    # A packet of AEDAT4 without events is the last one.
    path.write_bytes(path.read_bytes()[: {".aedat4": -20, ".txt": -3, ".csv": -3}.get(suffix, -1)])
    if suffix in (".txt", ".csv"):
        with pytest.raises(DataError, match=r"ends within a line at byte .*--drop-malformed"):
            opened(path).time_span()
    times = read(opened(path, drop_malformed=True))[:, 2].tolist()
    assert times == [t * 1000 for _, _, t, _ in ROWS[: len(times)]]
    assert len(times) >= len(ROWS) - 3
    assert "1 cut off at its end (the first a " in capsys.readouterr().out


@pytest.mark.parametrize("suffix", [".npz", ".dat"])
@pytest.mark.parametrize("kind", ["shuffled", "outside"])
def test_refuse_many_malformed_events(kind: str, suffix: str, folder: Path) -> None:
    path = folder / f"{kind}{suffix}"
    order = np.random.default_rng(0).permutation(len(ROWS)) if kind == "shuffled" else range(len(ROWS))
    WRITERS[suffix](path, [(x + WIDTH * (kind == "outside"), y, t, p) for x, y, t, p in (ROWS[i] for i in order)])
    for look in (read, lambda file: file.time_span()):
        with pytest.raises(DataError, match=r"of its 5,000 events are malformed.*only a thousandth"):
            look(opened(path, drop_malformed=True))


@pytest.mark.parametrize("columns", ["txyp", "xytp", "xypt"])
@pytest.mark.parametrize("suffix", [".txt", ".csv"])
def test_a_malformed_event_hides_no_order_of_the_columns(suffix: str, columns: str, folder: Path) -> None:
    path = folder / f"unnamed{suffix}"
    # The other kind of polarity does not count either.
    rows = [(x, y, t, int(p > 0)) for x, y, t, p in ROWS[:300]]
    rows.insert(100, (WIDTH + 500, 1, ROWS[100][2], -1))
    separator = "," if suffix == ".csv" else " "
    path.write_text("".join(separator.join(str(row["xytp".index(name)]) for name in columns) + "\n" for row in rows))
    found = read(opened(path, drop_malformed=True))
    np.testing.assert_array_equal(found, [(x, y, t * 1000, p) for x, y, t, p in ROWS[:300]])


def test_leave_out_events_between_the_files_of_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = np.array(ROWS[:2000]), np.array([(7, 7, 100_010, 1), *ROWS[2000:]])
    for index, part in enumerate(parts):
        np.save(tmp_path / f"{index}.npy", part)
    file = EsimEventFolder(tmp_path, WIDTH, HEIGHT)
    file.drop_malformed = True
    for _ in range(2):
        assert file.time_span() == (ROWS[0][2], ROWS[-1][2])
        np.testing.assert_array_equal(read(file)[:, 2], [t for _, _, t, _ in ROWS])
    assert capsys.readouterr().out.count("1 out of order (the first at 100010 ns)") == 1


@pytest.mark.parametrize("number", [1, 5])
def test_late_times_at_the_end_of_a_chunk_cost_no_later_event(
    number: int, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("aenerf_ns.files.event_table.CHUNK", 1000)
    rows = [(x, y, t + 10**6 * (1000 - number <= i < 1000), p) for i, (x, y, t, p) in enumerate(ROWS)]
    WRITERS[".npz"](folder / "late.npz", rows)
    file = opened(folder / "late.npz", drop_malformed=True)
    expected = [t * 1000 for _, _, t, _ in ROWS[: 1000 - number] + ROWS[1000:]]
    np.testing.assert_array_equal(read(file)[:, 2], expected)
    assert file.time_span() == (expected[0], expected[-1])
    assert f"left out: {number} out of order (the first at 11" in capsys.readouterr().out


def evt2_of(*values: int) -> bytes:
    return HEADER2 + words("<u4", *values)


def after_an_event(*values: int) -> bytes:
    return evt3_of(0x8010, 0x6001, 1, 0x2001, *values)


def after_good_times(*values: int) -> bytes:
    return evt3_of(*4 * (0x8010,), 0x6001, 1, 0x2001, *values)


FIRST, NEXT = 0x10001, 0x10003
OTHERS = (0x2005, 0x0007, 0x2006, 0x8001, 0x2007, 0x3008, 0x4FFF)
DAMAGED = {
    # Words, the times in microseconds of the events that are left, and how many are left out.
    "evt3: words ahead of the first time": (evt3_of(*OTHERS, 0x6002, 0x2009), [0x1002], 0),
    "evt3: empty lines of the header": (
        HEADER3.replace(b"% geo", b"%\n%\r\n% geo") + words("<u2", 0x8001, 0x6002, 7, 0x2009),
        [0x1002],
        0,
    ),
    "evt3: upper bits alone": (
        evt3_of(0x8001, 0x6FFF, 7, 0x2001, 0x8002, 0x2002, 0x8002, 0x6003, 0x8002, 0x2003),
        [0x1FFF, 0x2000, 0x2003],
        0,
    ),
    "evt3: padding of Lucid's cameras": (after_an_event(0x9999, 0x9999, 0x6003, 0x2002, 0x9999), [FIRST, NEXT], 0),
    "evt3: ahead": (after_an_event(0x8810, 0x2001, 0x8010, 0x6003, 0x2001), [FIRST, NEXT], 1),
    "evt3: one step ahead": (after_an_event(0x8011, 0x2001, 0x8010, 0x6003, 0x2001), [FIRST, NEXT], 1),
    "evt3: one step back": (after_an_event(0x800F, 0x2001, 0x8010, 0x6003, 0x2001), [FIRST, NEXT], 1),
    "evt3: at a step": (after_an_event(0x8A00, 0x2001, 0x2002, 0x8011, 0x6003, 0x2001), [FIRST, 0x11003], 2),
    "evt3: at the end": (after_an_event(0x8810, 0x2001, 0x2002), [FIRST], 2),
    "evt3: twice": (after_good_times(0x8810, 0x2001, 0x8810, 0x2002, 0x8010, 0x6003, 0x2001), [FIRST, NEXT], 2),
    "evt3: far back": (after_good_times(*2 * (0x8F10,), 0x2001, *2 * (0x8010,), 0x6003, 0x2001), [FIRST, NEXT], 1),
    "evt3: other words in a row": (
        after_an_event(0x8810, 0x2001, 0x8310, 0x2002, 0x8B10, 0x2002, 0x8010, 0x6003, 0x2001),
        [FIRST, NEXT],
        3,
    ),
    "evt3: vectors": (after_an_event(0x3001, 0x8810, 0x4005, 0x5003, 0x8010, 0x6003, 0x2001), [FIRST, NEXT], 4),
    "evt3: at the beginning": (
        evt3_of(0x8A10, 0x6001, 1, 0x2001, 0x8010, 0x6001, 0x2001, 0x8010, 0x6003, 0x2001),
        [FIRST, NEXT],
        1,
    ),
    "evt3: a pause": (after_an_event(0x8010, 0x8810, 0x8810, 0x6003, 0x2001), [FIRST, 0x810003], 0),
    "evt2: ahead": (evt2_of(0x80000010, 0x10000801, 0x88000010, 0x10000801, 0x80000010, 0x10400801), [1024, 1025], 1),
    "evt2: back": (evt2_of(0x80000010, 0x10000801, 0x80000002, 0x10000801, 0x80000010, 0x10400801), [1024, 1025], 1),
    "evt2: twice": (
        evt2_of(*4 * (0x80000010,), 0x10000801, *2 * (0x88000010, 0x10000801), 0x80000010, 0x10400801),
        [1024, 1025],
        2,
    ),
    "evt2: a pause": (
        evt2_of(0x80000010, 0x10000801, 0x80000010, 0x80008010, 0x80008010, 0x10400801),
        [1024, 0x200401],
        0,
    ),
}


@pytest.mark.parametrize("block", [1, 4, 1000])
@pytest.mark.parametrize("kind", DAMAGED)
def test_words_have_the_times_of_good_ones(
    kind: str, block: int, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("aenerf_ns.files.prophesee.BLOCK", block)
    content, times, number = DAMAGED[kind]
    path = folder / "damaged.raw"
    path.write_bytes(content)
    assert (read(open_event_file(path))[:, 2] // 1000).tolist() == times
    said = capsys.readouterr().out
    assert (f"{number} after a damaged time (the first at word" in said) == (number > 0)


def test_a_jump_of_the_time_that_stays_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def events(first: int) -> list[int]:
        return [word for high in range(first, first + 9) for word in (0x8000 | high, 0x6001, 0x0005, 0x2001)]

    path = folder / "restarted.raw"
    path.write_bytes(HEADER3 + np.array([*events(0x700), *events(0x100)], "<u2").tobytes())
    assert len(read(open_event_file(path))) == 18
    said = "restarted.raw: jumps of the camera's time by more than 65 ms, where events may be missing or its clock may "
    assert capsys.readouterr().out.count(said) == 1


def test_convert_leaves_out_malformed_events(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    events = random_events()
    write_calibration(tmp_path / "calibration.json")
    write_poses(tmp_path / "trajectory.txt")
    events["y"][17] = 306
    events["t"] = np.round(events["t"] * 1e6).astype(np.int64)
    events["t"][[500, 501]] -= 100_000
    np.savez(tmp_path / "events.npz", **events)
    words = [str(tmp_path), "--output", str(tmp_path / "made")]
    with pytest.raises(DataError, match="event 17 has y = 306"):
        tyro.cli(Convert, args=words).main()
    tyro.cli(Convert, args=[*words, "--drop-malformed"]).main()
    said = capsys.readouterr().out
    assert "1 with an impossible y (the first event 17, 306), 2 out of order (the first at " in said
    assert "1,997 of 1,997 events" in said
