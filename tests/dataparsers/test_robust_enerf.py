"""The format of Robust e-NeRF."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from helpers.published_datasets import config_of, recording_of, write_robust_enerf
from helpers.small_datasets import parse

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.dataset import EventDataset


def test_robust_enerf_states_its_sensor_and_views(tmp_path: Path) -> None:
    truth = write_robust_enerf(tmp_path / "made", model="equidistant")
    recording = recording_of(config_of("robust-enerf-data", truth.data))
    assert recording.sensor == SensorModel(0.25, 0.5, 1375, "RGGB")
    assert recording.event_camera.lens_model == "fisheye"
    assert recording.event_camera.distortion == truth.distortion
    assert recording.scene_box is None
    focal = 25 / np.tan(0.4)
    assert recording.frame_camera == CameraIntrinsics(50, 30, focal, focal, 25.0, 15.0)
    # Camera-to-world with OpenGL's axes in the file.
    view = recording.reference_views["test"][1]
    np.testing.assert_allclose(view.camera_to_world.numpy(), truth.poses[1], rtol=0, atol=1e-12)
    assert view.time is None


def test_views_one_folder_up_with_intrinsics(tmp_path: Path) -> None:
    truth = write_robust_enerf(tmp_path / "easy", views="../views")
    for split in ("val", "test"):
        path = tmp_path / "views" / f"transforms_{split}.json"
        meta = json.loads(path.read_text())
        del meta["camera_angle_x"]
        path.write_text(json.dumps({**meta, "intrinsics": [[40.0, 0, 24.5], [0, 41.0, 14.0], [0, 0, 1.0]]}))
    recording = recording_of(config_of("robust-enerf-data", truth.data))
    assert recording.frame_camera == CameraIntrinsics(50, 30, 40.0, 41.0, 25.0, 14.5)
    assert len(recording.reference_views["val"]) == 2


def test_synthetic_scene_has_box_and_white_background(tmp_path: Path) -> None:
    truth = write_robust_enerf(tmp_path / "made", synthetic=True)
    config = config_of("robust-enerf-data", truth.data)
    box = recording_of(config).scene_box
    assert box is not None
    assert box.tolist() == [[-1.5] * 3, [1.5] * 3]
    image = EventDataset(parse(config, "test")).get_image_float32(0)
    # Alpha 0.2 over white.
    torch.testing.assert_close(image[0, 0], 0.2 * torch.tensor([200, 100, 0]) / 255 + 0.8, rtol=0, atol=1e-6)
    assert recording_of(replace(config, scene_half_extent=0.0)).scene_box is None
