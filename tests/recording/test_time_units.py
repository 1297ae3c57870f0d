"""Units of the times of events and poses: taken as the help says, or named where the two do not fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import tyro
from helpers.own_recordings import random_events, write_calibration, write_poses
from numpy.typing import NDArray

from aenerf_ns.cli.convert import Convert
from aenerf_ns.dataparsers.own_recording import OwnRecordingDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.recording.dataset import EventDataset

Columns = dict[str, NDArray]


def write_hdf5(folder: Path, columns: Columns, polarity: type = np.int8) -> None:
    with h5py.File(folder / "events.h5", "w") as file:
        for name, dtype in (("x", np.uint16), ("y", np.uint16), ("t", np.int64), ("p", polarity)):
            file[f"events/{name}"] = columns[name].astype(dtype)


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
        lambda folder, e: write_npz(folder, e),
        lambda folder, e: write_text(folder, scaled(e, 1e6)),
    ],
    ids=["hdf5 of the native types", "hdf5", "npz of whole floats", "npz of decimals", "text"],
)
def test_whole_times_are_microseconds_and_decimals_seconds(
    write: Callable[[Path, Columns], None], recording: Path
) -> None:
    write(recording, random_events())
    assert window_of(recording) == pytest.approx((0, 2))


@pytest.mark.parametrize(
    ("write", "ticks", "unit"),
    [(write_npz, 1e9, "ns"), (write_hdf5, 1e9, "ns"), (write_text, 1e9, "ns"), (write_npz, 1e3, "ms")],
)
def test_message_names_the_unit_of_the_events(write: Callable, ticks: float, unit: str, recording: Path) -> None:
    write(recording, scaled(random_events(), ticks))
    with pytest.raises(DataError, match=f"give --event-time-unit {unit}"):
        window_of(recording)
    assert window_of(recording, event_time_unit=unit) == pytest.approx((0, 2), abs=1e-2)


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


def test_refuse_events_of_which_hardly_any_has_a_pose(recording: Path, tmp_path: Path) -> None:
    write_npz(recording, scaled(random_events(30), 1e6))
    outputs = OwnRecordingDataParserConfig(data=recording).setup().get_dataparser_outputs()
    with pytest.raises(DataError, match=r"only 134 of its 2,000 events have a pose.*--start-time-ns"):
        _ = EventDataset(outputs).pairs
    with pytest.raises(DataError, match="only 134 of its 2,000 events have a pose"):
        _ = EventDataset(outputs).windows
    words = [str(recording), "--output", str(tmp_path / "made")]
    with pytest.raises(DataError, match="only 134 of its 2,000 events have a pose"):
        tyro.cli(Convert, args=words).main()
    assert not (tmp_path / "made").exists()
    # Whoever chooses a part means it.
    tyro.cli(Convert, args=[*words, "--end-time-ns", "30000000000"]).main()
    parser = OwnRecordingDataParserConfig(data=recording, start_time_ns=0).setup()
    assert len(EventDataset(parser.get_dataparser_outputs()).pairs) > 0
