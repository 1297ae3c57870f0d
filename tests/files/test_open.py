"""Open event files of any format: real ones beside independent readers, made ones there and back, damaged ones."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.bag_writers import PACKET, START, array_bag, packet_messages, write_bag, write_bag2
from helpers.event_file_checks import EDITS, attempt, edited, read, survives, table, vendor_file
from helpers.event_file_writers import ENCODERS, HEIGHT, ROWS, WIDTH, Rows, aedat4_file, evt2
from helpers.streams import FUZZ_EXAMPLES
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aenerf_ns.errors import DataError
from aenerf_ns.files import event_reader, evt_words, prophesee
from aenerf_ns.files.open import open_event_file

# Microseconds in which times can be told apart from wrapped ones, less a margin.
LONGEST_GAP = {"evt2": 8_000_000_000, "evt3": 16_600_000, "dat": 2_100_000_000, "aedat4": 10**15 // 100}
LAPS = {"evt2": 1 << 34, "evt3": 1 << 24, "dat": 1 << 32, "aedat4": 1 << 60}


@st.composite
def recordings(draw: st.DrawFn, longest_gap: int) -> Rows:
    """Events with equal times, neighbors in a row, short and long gaps."""
    gap = st.one_of(st.just(0), st.integers(0, 5000), st.integers(0, longest_gap))
    neighbors = st.lists(st.integers(1, 4), max_size=12)
    events = st.tuples(gap, st.integers(0, WIDTH - 1), st.integers(0, HEIGHT - 1), st.sampled_from([-1, 1]), neighbors)
    rows, time = [], draw(st.integers(0, 20_000_000))
    for step, x, y, p, distances in draw(st.lists(events, min_size=1, max_size=30)):
        time += step
        columns = np.cumsum([x, *distances])
        rows += [(int(column), y, time, p) for column in columns if column < WIDTH]
    return rows


@pytest.mark.parametrize("name", ENCODERS)
def test_read_what_was_encoded_in_any_pieces(name: str, folder: Path) -> None:
    @settings(max_examples=60, deadline=None)
    @given(recordings(LONGEST_GAP[name]), st.integers(12, 60), st.integers(1, 9))
    def check(rows: Rows, chunk: int, block: int) -> None:
        path = folder / f"there_and_back.{name}"
        path.write_bytes(ENCODERS[name](rows))
        expected = table(rows)
        # How often the time wrapped before the first event is not known.
        expected[:, 2] -= rows[0][2] // LAPS[name] * LAPS[name] * 1000
        for is_small in (False, True):
            with pytest.MonkeyPatch.context() as patch:
                if is_small:
                    for module in (evt_words, prophesee, event_reader):
                        patch.setattr(module, "CHUNK", chunk)
                    patch.setattr(prophesee, "BLOCK", block)
                file = open_event_file(path)
                assert (file.width, file.height) == (WIDTH, HEIGHT)
                np.testing.assert_array_equal(read(file), expected)
                assert file.time_span() == (expected[0, 2], expected[-1, 2])
                assert file.count() in (None, len(rows))

    check()


@pytest.mark.parametrize(
    ("name", "size", "count", "first", "last"),
    [
        ("evt2.raw", (640, 480), 521_252, (35, 443, 913_716_224_000, 1), (12, 471, 913_812_095_000, -1)),
        ("evt3.raw", (1280, 720), 1_218_618, (484, 315, 11_200_224_000, 1), (471, 350, 21_968_221_000, -1)),
        ("gen4.dat", (1280, 720), 1_218_618, (484, 315, 5_856_000, 1), (471, 350, 10_773_853_000, -1)),
        (
            "davis346.aedat4",
            (346, 260),
            78_830,
            (215, 164, 1_589_163_147_368_868_000, 1),
            (233, 205, 1_589_163_149_728_813_000, 1),
        ),
    ],
)
def test_real_files_agree_with_independent_reader(
    name: str, size: tuple[int, int], count: int, first: tuple[int, ...], last: tuple[int, ...]
) -> None:
    file = open_event_file(vendor_file(name), *size)
    events = read(file)
    assert len(events) == count
    assert tuple(events[0]) == first
    assert tuple(events[-1]) == last
    assert file.time_span() == (first[2], last[2])
    assert file.count() == (count if name.endswith(".dat") else None)
    faery = pytest.importorskip("faery")
    # The header of evt2.raw does not tell the size.
    other = faery.events_stream_from_file(vendor_file(name), dimensions_fallback=(640, 480)).to_array()
    columns = other["x"], other["y"], other["t"].astype(np.int64) * 1000, np.where(other["on"], 1, -1)
    np.testing.assert_array_equal(events, np.stack(columns, -1, dtype=np.int64, casting="unsafe"))


def test_size_is_stated_or_given(folder: Path) -> None:
    rows = [(1, 2, 3, 1)]
    path = folder / "sized.raw"
    without = evt2(rows).replace(f"% geometry {WIDTH}x{HEIGHT}\n".encode(), b"")
    path.write_bytes(without)
    with pytest.raises(DataError, match="does not state the size"):
        open_event_file(path)
    file = open_event_file(path, 10, 20)
    assert (file.width, file.height) == (10, 20)
    for encode in ENCODERS.values():
        path.write_bytes(encode(rows))
        with pytest.raises(DataError, match=r"64 x 48 pixels, but 10 x 20 were given"):
            open_event_file(path, 10, 20).time_span()
    path.write_bytes(aedat4_file(rows, size=""))
    with pytest.raises(DataError, match="does not state the size"):
        open_event_file(path)
    np.testing.assert_array_equal(read(open_event_file(path, 10, 20)), table(rows))


def test_missing_file_opens_with_its_size(folder: Path) -> None:
    for suffix in ("raw", "dat", "aedat4", "bag", "h5", "npy", "npz", "txt", "csv"):
        file = open_event_file(folder / f"gone.{suffix}", WIDTH, HEIGHT)
        assert (file.width, file.height) == (WIDTH, HEIGHT)
        with pytest.raises(DataError, match="there is no such file"):
            file.time_span()
        with pytest.raises(DataError, match="there is no such file"):
            next(file.chunks())


def test_content_tells_the_format(folder: Path) -> None:
    for name, encode in ENCODERS.items():
        path = folder / "misnamed.txt"
        path.write_bytes(encode([(1, 2, 3, 1)]))
        assert read(open_event_file(path)).tolist() == [[1, 2, 3000, 1]], name


def test_refuse_a_folder_that_is_no_bag(folder: Path) -> None:
    with pytest.raises(DataError, match=r"without .* ros2 bag reindex it"):
        open_event_file(folder)


def made_files(folder: Path) -> dict[str, bytes]:
    """One small file of each kind."""
    files = {name: encode(ROWS) for name, encode in ENCODERS.items()}
    files["aedat4 with a table"] = aedat4_file(ROWS, with_table=True)
    files["aedat4 in lz4"] = aedat4_file(ROWS, 1, pytest.importorskip("lz4.frame").compress, with_table=True)
    rows = [(x, y, START // 1000 + t, p) for x, y, t, p in ROWS]
    for compress in ("", "LZ4", "BZ2"):
        files[f"arrays {compress}"] = array_bag(folder / "fuzz_base.bag", rows, compress).read_bytes()
    messages = packet_messages(ROWS, [START + 1000 * row[2] for row in ROWS], 9)
    files["packets"] = write_bag(folder / "fuzz_base.bag", {"/events": (PACKET, messages)}).read_bytes()
    for storage, suffix in (("SQLITE3", "db3"), ("MCAP", "mcap")):
        (stored,) = write_bag2(folder / "fuzz_base", messages, PACKET, storage).glob(f"*.{suffix}")
        files[f"packets.{suffix}"] = stored.read_bytes()
    return files


def test_damaged_files_raise_only_clear_errors(folder: Path) -> None:
    files = made_files(folder)

    def path_of(name: str) -> Path:
        # The suffix tells the storage of bags of ROS 2.
        return folder / f"fuzz{Path(name).suffix}"

    @settings(max_examples=FUZZ_EXAMPLES * 3, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(sorted(files)), EDITS)
    def check(name: str, edits: list[tuple[str, float, int]]) -> None:
        path_of(name).write_bytes(edited(files[name], edits))
        survives(path_of(name))

    for name, content in files.items():
        path_of(name).write_bytes(content)
        attempt(open_event_file(path_of(name)))
    check()


@pytest.mark.parametrize(("compression", "package"), [(1, "lz4.frame"), (2, "lz4.frame"), (4, "backports.zstd")])
def test_compressed_packets_of_aedat4(
    compression: int, package: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compress = pytest.importorskip(package).compress
    rows = [(x, 7, 1_600_000_000_000_000 + x, 1 - 2 * (x % 2)) for x in range(20)]
    path = folder / "packed.aedat4"
    path.write_bytes(aedat4_file(rows, compression, compress, with_table=True))
    file = open_event_file(path)
    np.testing.assert_array_equal(read(file), table(rows))
    assert file.time_span() == (rows[0][2] * 1000, rows[-1][2] * 1000)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DataError, match=re.escape("pip install 'aenerf-ns[aedat4]'")):
        read(file)


def test_choose_a_stream_of_aedat4(folder: Path) -> None:
    path = folder / "stereo.aedat4"
    path.write_bytes(aedat4_file([(1, 2, 3, 1)], streams={0: "EVTS", 4: "EVTS"}))
    with pytest.raises(DataError, match="several streams hold events; choose one of 0, 4"):
        open_event_file(path)
    assert len(read(open_event_file(path, topic="0"))) == 1
    with pytest.raises(DataError, match="holds no events"):
        read(open_event_file(path, topic="4"))
