"""The format of EventNeRF."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.dataset_faults import assert_one_clear_line, edit_npz, remove, write_text
from helpers.published_datasets import (
    DURATION,
    N_EVENTS,
    config_of,
    recording_of,
    write_eventnerf,
)

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
    with pytest.raises(DataError, match=r"2 training splits; give one as --data, such as .*train1"):
        recording_of(config_of("eventnerf-data", truth.data))
    split = recording_of(config_of("eventnerf-data", truth.data / "train2"))
    assert len(split.reference_views["val"]) == 3
    # Without others the images of the training split serve.
    for name in ("validation", "test"):
        shutil.rmtree(truth.data / name)
    split = recording_of(config_of("eventnerf-data", truth.data / "train2"))
    assert (len(split.reference_views["val"]), len(split.reference_views["test"])) == (11, 10)


def test_a_unit_of_time_may_be_given_for_poses_without_times(tmp_path: Path) -> None:
    truth = write_eventnerf(tmp_path / "made")
    recording = recording_of(config_of("eventnerf-data", truth.data, time_unit="ns"))
    assert recording.trajectory.end == recording.event_file.time_span()[1] == DURATION
    recording = recording_of(config_of("eventnerf-data", truth.data, first_pose_time_ns=5, last_pose_time_ns=105))
    assert recording.trajectory.times.tolist() == list(range(5, 106, 5))


FAULTS = {
    "no events": (remove("train/events"), "events.npz: there is no such file"),
    "two event files": (
        lambda folder: np.savez(folder / "train/events/b.npz"),
        "train/events: it holds 2 .npz files; there must be one",
    ),
    "no poses": (remove("train/pose/*"), "train/pose: it holds no .txt file"),
    "no split": (remove("train"), "there is no train/pose; give the folder of a scene"),
    "no intrinsics": (remove("train/intrinsics/*"), "train/intrinsics: it holds no .txt file"),
    "3 x 4": (write_text("train/pose/r_00003.txt", "1 " * 12), "r_00003.txt: it holds 12 numbers; it must hold 4 x 4"),
    "a word": (write_text("train/pose/r_00003.txt", "1 " * 15 + "one"), "r_00003.txt: not a number"),
    "NaN pose": (write_text("train/pose/r_00003.txt", "nan " * 16), "r_00003.txt: a number is not finite"),
    "mirrored": (
        write_text("train/pose/r_00003.txt", "1 0 0 0  0 1 0 0  0 0 -1 0  0 0 0 1"),
        "train/pose: pose 3 is not a rigid motion",
    ),
    "no focal length": (write_text("train/intrinsics/r_00000.txt", "0 " * 16), "fx must be from 0.01"),
    "lost image": (remove("train/rgb/00003.png"), "train/rgb: it holds 20 images for 21 poses"),
    "lost test image": (remove("test/rgb/00001.png"), "test/rgb: it holds 1 images for 2 poses"),
    "one event time": (
        edit_npz("train/events/test_lego.npz", t=np.zeros(N_EVENTS, int)),
        "train/pose: pose 1 is at 0 ns, not after",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_malformed_datasets_are_one_clear_line(fault: str, tmp_path: Path) -> None:
    change, message = FAULTS[fault]
    config = config_of("eventnerf-data", write_eventnerf(tmp_path / "made").data)
    assert_one_clear_line(change, message, config)
