"""EDS as downloaded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
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
