"""EDS as downloaded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from helpers.published_datasets import CAMCHAIN, EPOCH, config_of, interpolated, make_poses, recording_of, write_eds


def test_eds_views_are_those_of_the_frame_camera(tmp_path: Path) -> None:
    truth = write_eds(tmp_path / "made")
    (tmp_path / "chain.yaml").write_text(yaml.dump(CAMCHAIN))
    given = recording_of(config_of("eds-data", truth.data, calibration=tmp_path / "chain.yaml"))
    assert (given.event_camera.fx, given.frame_camera.fx) == (50.0, 70.0)
    view = given.reference_views["train"][1]
    assert view.time == (EPOCH + 800_000) * 1_000
    # Kalibr's matrix takes points from the frame camera to the event camera.
    expected = interpolated(truth, view.time) @ make_poses(3)[2]
    np.testing.assert_allclose(view.camera_to_world.numpy(), expected, rtol=0, atol=1e-9)
