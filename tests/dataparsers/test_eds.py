"""EDS as downloaded."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from helpers.dataset_faults import assert_one_clear_line, remove, write_text
from helpers.published_datasets import (
    EPOCH,
    config_of,
    interpolated,
    make_poses,
    recording_of,
    write_eds,
)

from aenerf_ns.camera.intrinsics import CameraIntrinsics


def test_eds_views_are_those_of_the_frame_camera(tmp_path: Path) -> None:
    truth = write_eds(tmp_path / "made")
    chain = {
        "cam0": {
            "intrinsics": [766.0, 767.0, 291.0, 227.0],
            "resolution": [640, 480],
            "distortion_coeffs": [0.1, 0, 0, 0],
        },
        "cam1": {
            "camera_model": "pinhole",
            "distortion_model": "radtan",
            "intrinsics": [560.0, 561.0, 313.0, 217.0],
            "resolution": [640, 480],
            "distortion_coeffs": [-0.1, 0.2, 0.003, 0.004],
            "T_cn_cnm1": make_poses(3)[1].tolist(),
        },
    }
    (tmp_path / "chain.yaml").write_text(yaml.dump(chain))
    given = recording_of(config_of("eds-data", truth.data, calibration=tmp_path / "chain.yaml"))
    assert given.event_camera == CameraIntrinsics(
        640, 480, 560.0, 561.0, 313.5, 217.5, distortion=(-0.1, 0.2, 0.003, 0.004, 0.0)
    )
    assert given.frame_camera.cx == 291.5
    view = given.reference_views["train"][1]
    assert view.time == (EPOCH + 800_000) * 1_000
    # Kalibr's matrix takes points from the frame camera to the event camera.
    expected = interpolated(truth, view.time) @ make_poses(3)[1]
    np.testing.assert_allclose(view.camera_to_world.numpy(), expected, rtol=0, atol=1e-9)


FAULTS = {
    "no poses": (remove("stamped*"), "stamped_groundtruth.txt: there is no such file"),
    "no events": (remove("events.h5"), "events.h5: there is no such file"),
    "no column": (lambda folder: h5py.File(folder / "events.h5", "a").pop("p"), "there is no dataset /p"),
    "five images": (write_text("images_timestamps.txt", "1\n2\n3\n4\n5\n"), "it has 5 times for 3 images"),
    "image time is a word": (write_text("images_timestamps.txt", "1\ntwo\n3\n"), "two is not a time in microseconds"),
    "huge time": (write_text("images_timestamps.txt", "1\n2\n1e99999999\n"), "1e99999999 is not a time in micro"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_malformed_datasets_are_one_clear_line(fault: str, tmp_path: Path) -> None:
    change, message = FAULTS[fault]
    config = config_of("eds-data", write_eds(tmp_path / "made").data)
    assert_one_clear_line(change, message, config)
