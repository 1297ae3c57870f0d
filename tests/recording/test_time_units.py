"""Units of the times of events and poses: taken as the help says, or named where the two do not fit."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tyro
from helpers.event_table_writers import Columns, write_eds
from helpers.own_recordings import random_events, write_calibration, write_poses

from aenerf_ns.cli.convert import Convert
from aenerf_ns.dataparsers.ecd import EcdDataParserConfig
from aenerf_ns.dataparsers.own_recording import OwnRecordingDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.recording.dataset import EventDataset


def write_hdf5(folder: Path, columns: Columns, polarity: type = np.int8) -> None:
    dtypes = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": polarity}
    write_eds(folder / "events.h5", {f"events/{name}": columns[name].astype(dtype) for name, dtype in dtypes.items()})


def write_npz(folder: Path, columns: Columns) -> None:
    np.savez(folder / "events.npz", **columns)


def write_text(folder: Path, columns: Columns) -> None:
    np.savetxt(folder / "events.txt", np.stack([columns[name] for name in "txyp"], 1), fmt="%d")


def scaled(columns: Columns, ticks: float, dtype: type = np.int64) -> Columns:
    return {**columns, "t": np.round(columns["t"] * ticks).astype(dtype)}


def window_of(folder: Path, **options: object) -> tuple[float, float]:
    window = OwnRecordingDataParserConfig(data=folder, **options).setup().time_window
    return window.start * 1e-9, window.end * 1e-9


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A folder without events."""
    write_calibration(tmp_path / "calibration.json")
    write_poses(tmp_path / "trajectory.txt")
    return tmp_path


@pytest.mark.parametrize(
    "write",
    [
        lambda folder, e: write_hdf5(folder, scaled({**e, "p": 2 * e["p"] - 1}, 1e6)),
        lambda folder, e: write_hdf5(folder, scaled(e, 1e6), np.uint8),
        lambda folder, e: write_npz(folder, scaled(e, 1e6, np.float64)),
        lambda folder, e: write_npz(
            folder, {**e, "t": np.where(np.arange(2_000) == 7, np.nan, np.round(e["t"] * 1e6))}
        ),
        lambda folder, e: write_npz(folder, e),
        lambda folder, e: write_text(folder, scaled(e, 1e6)),
    ],
    ids=["hdf5 of the native types", "hdf5", "npz of whole floats", "npz with NaN", "npz of decimals", "text"],
)
def test_whole_times_are_microseconds_and_decimals_seconds(
    write: Callable[[Path, Columns], None], recording: Path
) -> None:
    write(recording, random_events())
    assert window_of(recording, drop_malformed=True) == pytest.approx((0, 2))


@pytest.mark.parametrize(
    ("write", "ticks", "unit"),
    [(write_npz, 1e9, "ns"), (write_hdf5, 1e9, "ns"), (write_text, 1e9, "ns"), (write_npz, 1e3, "ms")],
)
def test_message_names_the_unit_of_the_events(write: Callable, ticks: float, unit: str, recording: Path) -> None:
    write(recording, scaled(random_events(), ticks))
    for given in ({}, {"event_time_unit": "us"}):
        with pytest.raises(DataError, match=f"give --event-time-unit {unit}"):
            window_of(recording, **given)
    assert window_of(recording, event_time_unit=unit) == pytest.approx((0, 2), abs=1e-2)


def test_message_names_the_unit_of_events_that_their_format_has_in_nanoseconds(recording: Path) -> None:
    x, y, t, p = (scaled(random_events(), 1e6)[name] for name in "xytp")
    np.savez(recording / "events.npz", position=np.stack([x, y], 1), timestamp=t, polarity=p)
    with pytest.raises(DataError, match="give --event-time-unit us"):
        window_of(recording)
    assert window_of(recording, event_time_unit="us") == pytest.approx((0, 2))


def test_message_names_the_unit_of_events_in_the_middle_of_the_poses(recording: Path) -> None:
    write_npz(recording, scaled(random_events(0.2, 1.2), 1e9))
    with pytest.raises(DataError, match="give --event-time-unit ns"):
        window_of(recording)


@pytest.mark.parametrize(("ticks", "unit", "poses"), [(1e6, 1e-6, True), (1, 1, False)])
def test_blame_nothing_that_no_recording_lasts(ticks: float, unit: float, poses: bool, recording: Path) -> None:
    """Poses in microseconds are not made right by events in seconds, nor are events in seconds by other poses."""
    write_npz(recording, scaled(random_events(), ticks))
    write_poses(recording / "trajectory.txt", unit=unit)
    with pytest.raises(DataError) as error:
        window_of(recording)
    assert ("those of the poses" in str(error.value) or "the poses were in microseconds" in str(error.value)) == poses
    assert ("give --event-time-unit s" in str(error.value)) != poses


@pytest.mark.parametrize("write", [write_npz, write_text])
def test_one_late_event_is_no_other_unit(write: Callable, recording: Path) -> None:
    events = scaled(random_events(), 1e6)
    events["t"][-1] = 900_000_000
    write(recording, events)
    assert window_of(recording) == pytest.approx((0, 2))


@pytest.mark.parametrize(
    ("ticks", "decimals", "unit", "words"),
    [
        (1e6, 0, 1, "the events were 1,000,000 times too large, or those of the poses too small"),
        (1, 9, 1e-3, "the events were 1,000 times too small, or those of the poses too large"),
    ],
)
def test_formats_without_an_option_name_the_factor(
    ticks: float, decimals: int, unit: float, words: str, tmp_path: Path
) -> None:
    columns = random_events()
    rows = np.stack([columns["t"] * ticks, *(columns[name] for name in "xyp")], 1)
    np.savetxt(tmp_path / "events.txt", rows, fmt=[f"%.{decimals}f", "%d", "%d", "%d"])
    write_poses(tmp_path / "groundtruth.txt", unit=unit)
    (tmp_path / "calib.txt").write_text("90 90 47.5 35.5 0 0 0 0 0\n")
    with pytest.raises(DataError, match=f"{words}; correct the unit of either"):
        _ = EcdDataParserConfig(data=tmp_path, width=96, height=72).setup().time_window


@pytest.mark.parametrize("hertz", [50, 1000])
def test_message_names_the_unit_of_dense_poses(hertz: int, recording: Path) -> None:
    write_npz(recording, scaled(random_events(20), 1e6))
    write_poses(recording / "trajectory.txt", 20, hertz, unit=1e-3)
    with pytest.raises(DataError, match="those of the poses were in milliseconds"):
        window_of(recording)


@pytest.mark.parametrize(("start", "events", "poses"), [(7, 0.1, 60), (0, 0.1, 60), (0, 60, 9), (0, 0.02, 0.1)])
def test_parts_of_right_recordings_are_read(start: float, events: float, poses: float, recording: Path) -> None:
    write_npz(recording, scaled(random_events(events, start), 1e6))
    write_poses(recording / "trajectory.txt", poses, 200)
    begin, end = window_of(recording)
    assert begin == start
    assert end == pytest.approx(min(start + events, poses), abs=1e-5)


def test_a_short_part_that_looks_like_another_unit_is_read_when_it_is_named(recording: Path) -> None:
    write_npz(recording, scaled(random_events(0.1), 1e6))
    write_poses(recording / "trajectory.txt", 10, 50)
    with pytest.raises(DataError, match="if this part is what you want, give its start-time-ns and end-time-ns"):
        window_of(recording)
    assert window_of(recording, start_time_ns=0, end_time_ns=10**8) == pytest.approx((0, 0.1))
    words = [str(recording), "--output", str(recording / "made"), "--start-time-ns", "0", "--end-time-ns", "100000000"]
    tyro.cli(Convert, args=words).main()


def test_refuse_events_of_which_hardly_any_has_a_pose(recording: Path, tmp_path: Path) -> None:
    write_npz(recording, scaled(random_events(30), 1e6))
    outputs = OwnRecordingDataParserConfig(data=recording).setup().get_dataparser_outputs()
    with pytest.raises(DataError, match=r"only 134 of its 2,000 events have a pose.*--start-time-ns"):
        _ = EventDataset(outputs).pairs
    with pytest.raises(DataError, match="only 134 of its 2,000 events have a pose"):
        _ = EventDataset(outputs).windows
    # Also where so few are left that none are pairs.
    write_poses(recording / "trajectory.txt", 1.0)
    outputs = OwnRecordingDataParserConfig(data=recording).setup().get_dataparser_outputs()
    with pytest.raises(DataError, match="only 67 of its 2,000 events have a pose"):
        _ = EventDataset(outputs).pairs
    write_poses(recording / "trajectory.txt")
    words = [str(recording), "--output", str(tmp_path / "made")]
    with pytest.raises(DataError, match="only 134 of its 2,000 events have a pose"):
        tyro.cli(Convert, args=words).main()
    assert not (tmp_path / "made").exists()
    # Whoever chooses a part means it.
    tyro.cli(Convert, args=[*words, "--end-time-ns", "30000000000"]).main()
    parser = OwnRecordingDataParserConfig(data=recording, start_time_ns=0).setup()
    assert len(EventDataset(parser.get_dataparser_outputs()).pairs) > 0
