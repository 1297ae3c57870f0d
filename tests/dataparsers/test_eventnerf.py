"""The format of EventNeRF."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.published_datasets import DURATION, config_of, recording_of, write_eventnerf

from aenerf_ns.dataparsers.formats import recognize
from aenerf_ns.errors import DataError


def test_eventnerf_splits_and_images(tmp_path: Path) -> None:
    truth = write_eventnerf(tmp_path / "made")
    recording = recording_of(config_of("eventnerf-data", truth.data))
    assert recording.sensor.bayer_pattern == "RGGB"
    assert {split: len(views) for split, views in recording.reference_views.items()} == {
        "train": 21,
        "val": 3,
        "test": 2,
    }
    assert [view.time for view in recording.reference_views["train"]] == truth.times.tolist()
    np.testing.assert_allclose(recording.reference_views["test"][1].camera_to_world.numpy(), truth.poses[1], atol=1e-12)
    assert recording.scene_box is not None
    # A split by itself, and a scene with several.
    assert recognize(truth.data / "train") == "eventnerf-data"
    (truth.data / "train").rename(truth.data / "train1")
    shutil.copytree(truth.data / "train1", truth.data / "train2")
    with pytest.raises(DataError, match=r"2 training splits .*train1"):
        recording_of(config_of("eventnerf-data", truth.data))
    split = recording_of(config_of("eventnerf-data", truth.data / "train2"))
    assert len(split.reference_views["val"]) == 3
    # Without others the images of the training split serve.
    for name in ("validation", "test"):
        shutil.rmtree(truth.data / name)
    split = recording_of(config_of("eventnerf-data", truth.data / "train2"))
    assert (len(split.reference_views["val"]), len(split.reference_views["test"])) == (11, 10)


def test_poses_without_times_take_a_unit(tmp_path: Path) -> None:
    truth = write_eventnerf(tmp_path / "made")
    recording = recording_of(config_of("eventnerf-data", truth.data, time_unit="ns"))
    assert recording.trajectory.end == recording.event_file.time_span()[1] == DURATION
    recording = recording_of(config_of("eventnerf-data", truth.data, first_pose_time_ns=5, last_pose_time_ns=105))
    assert recording.trajectory.times.tolist() == list(range(5, 106, 5))
