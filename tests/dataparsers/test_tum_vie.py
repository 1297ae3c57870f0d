"""TUM-VIE as downloaded."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.published_datasets import (
    EPOCH,
    assert_same_poses,
    config_of,
    convert_to_native,
    interpolated,
    recording_of,
    tum_vie_matrix,
    write_tum_vie,
)
from helpers.small_datasets import parse
from helpers.unpacked_pairs import unpacked

from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.dataparsers.formats import recognize
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.tum_trajectory import write_tum_trajectory
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.scene import SCENE_KEY


def test_tum_vie_has_two_calibrations_and_two_sides(tmp_path: Path, tum_vie_calibration: Path) -> None:
    for sequence, side in (("mocap-desk2", "right"), ("office-maze", "left"), ("office-maze", "right")):
        folder = tmp_path / f"{sequence}-{side}"
        truth = write_tum_vie(folder, tum_vie_calibration, sequence, side)
        recording = recording_of(config_of("tum-vie-data", folder / f"{sequence}-events_{side}.h5"))
        assert_same_poses(recording.trajectory.camera_to_worlds, truth.poses)
        assert recording.event_camera.fx == truth.matrix[0, 0]
        assert recording.event_camera.cx == truth.matrix[0, 2] + 0.5
        assert recording.sensor == SensorModel(1.458 * 0.25, 0.25, 1375)
    # The calibration may be one folder up.
    for file in folder.glob("*.json"):
        file.rename(tmp_path / file.name)
    recording_of(config_of("tum-vie-data", folder / "office-maze-events_right.h5"))


def test_tum_vie_views_are_those_of_the_frame_camera(tmp_path: Path, tum_vie_calibration: Path) -> None:
    truth = write_tum_vie(tmp_path / "made", tum_vie_calibration)
    recording = recording_of(config_of("tum-vie-data", truth.data))
    cameras = json.loads((tum_vie_calibration / "camera-calibrationA.json").read_text())["value0"]
    imu_from_frame, _, imu_from_event, _ = map(tum_vie_matrix, cameras["T_imu_cam"])

    for view, time in zip(recording.reference_views["train"], (100_000, 333_333, 1_900_000), strict=True):
        assert view.time == (EPOCH + time) * 1_000
        expected = interpolated(truth, view.time) @ np.linalg.inv(imu_from_event) @ imu_from_frame
        np.testing.assert_allclose(view.camera_to_world.numpy(), expected, rtol=0, atol=1e-9)
    assert recording.frame_camera.width == recording.frame_camera.height == 1024
    assert recording.frame_camera.cx == cameras["intrinsics"][0]["intrinsics"]["cx"] + 0.5
    assert [len(recording.reference_views[split]) for split in ("train", "val", "test")] == [3, 2, 1]


def test_gap_of_poses_is_left_out_after_conversion_too(
    tmp_path: Path, tum_vie_calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = write_tum_vie(tmp_path / "made", tum_vie_calibration)
    path = truth.data / "mocap-desk2-vi_gt_data" / "mocap_data.txt"
    header, *rows = path.read_text().splitlines(keepends=True)
    # Poses are 8.3 ms apart: one lost is no gap, a second is.
    path.write_text("".join([header, *rows[:30], *rows[31:61], *rows[181:]]))
    config = config_of("tum-vie-data", truth.data)
    gap = (int(truth.times[60]), int(truth.times[181]))
    folder = convert_to_native(recording_of(config), tmp_path / "native")
    capsys.readouterr()
    for parser in (config, NativeDataParserConfig(data=folder)):
        outputs = parse(parser)
        assert (
            " ".join(capsys.readouterr().out.split()).count("The poses have 1 gap(s) of more than 0.05 s, 1.0 s in")
            == 1
        )
        assert outputs.metadata[SCENE_KEY].window.gaps == (gap,)
        pairs = EventDataset(outputs).pairs
        times = truth.events["t"] * 1_000
        assert pairs.num_outside == int(((times > gap[0]) & (times < gap[1])).sum()) > 50
        intervals = [pair[2:4] for pair in unpacked(pairs)]
        assert all(end <= gap[0] or begin >= gap[1] for begin, end in intervals)
        assert any(end <= gap[0] for _, end in intervals)
        assert any(begin >= gap[1] for begin, _ in intervals)
    # An image in the gap has no pose: here none of the three, so one is moved there.
    stamps = truth.data / "mocap-desk2-vi_gt_data" / "left_images" / "image_timestamps_left.txt"
    stamps.write_text(f"{EPOCH + 100_000}\n{EPOCH + 900_000}\n{EPOCH + 1_900_000}\n")
    views = recording_of(config).reference_views["train"]
    assert [view.file.name for view in views] == ["00000.jpg", "00002.jpg"]
    # Poses that are given in place of the motion capture have gaps of their own.
    write_tum_trajectory(tmp_path / "slow.txt", Trajectory(truth.times[::30], torch.from_numpy(truth.poses[::30])))
    given = replace(config, trajectory=tmp_path / "slow.txt")
    assert parse(given).metadata[SCENE_KEY].window.gaps == ()
    assert recording_of(given).ground_truth is not None
    # Another limit may be given.
    assert parse(replace(config, max_pose_gap_ns=2 * 10**9)).metadata[SCENE_KEY].window.gaps == ()


def test_choose_one_of_several_sequences(tmp_path: Path, tum_vie_calibration: Path) -> None:
    for sequence in ("mocap-desk2", "office-maze"):
        write_tum_vie(tmp_path / "made", tum_vie_calibration, sequence)
    with pytest.raises(DataError, match=r"it holds 2 sequences .*/mocap-desk2-events_left.h5"):
        recording_of(config_of("tum-vie-data", tmp_path / "made"))
    one = tmp_path / "made" / "office-maze-events_left.h5"
    assert recognize(one) == "tum-vie-data"
    assert recording_of(config_of("tum-vie-data", one)).event_file.path == one
