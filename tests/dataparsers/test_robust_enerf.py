"""The format of Robust e-NeRF."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.dataset_faults import assert_one_clear_line, edit_json, edit_npz, remove, write_text
from helpers.published_datasets import (
    N_POSES,
    config_of,
    recording_of,
    write_robust_enerf,
)
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
    assert recording_of(
        config_of("robust-enerf-data", truth.data, refractory_period_ns=0, negative_contrast_threshold=0.3)
    ).sensor == SensorModel(0.25, 0.3, 0, "RGGB")


def test_robust_enerf_views_may_be_one_folder_up_and_have_intrinsics(tmp_path: Path) -> None:
    truth = write_robust_enerf(tmp_path / "easy", views="../views")
    for split in ("val", "test"):
        path = tmp_path / "views" / f"transforms_{split}.json"
        meta = json.loads(path.read_text())
        del meta["camera_angle_x"]
        path.write_text(json.dumps({**meta, "intrinsics": [[40.0, 0, 24.5], [0, 41.0, 14.0], [0, 0, 1.0]]}))
    recording = recording_of(config_of("robust-enerf-data", truth.data))
    assert recording.frame_camera == CameraIntrinsics(50, 30, 40.0, 41.0, 25.0, 14.5)
    assert len(recording.reference_views["val"]) == 2


def test_synthetic_scenes_of_robust_enerf_have_a_box_and_a_white_background(tmp_path: Path) -> None:
    truth = write_robust_enerf(tmp_path / "made", synthetic=True)
    config = config_of("robust-enerf-data", truth.data)
    box = recording_of(config).scene_box
    assert box is not None
    assert box.tolist() == [[-1.5] * 3, [1.5] * 3]
    image = EventDataset(parse(config, "test")).get_image_float32(0)
    # Alpha 0.2 over white.
    torch.testing.assert_close(image[0, 0], 0.2 * torch.tensor([200, 100, 0]) / 255 + 0.8, rtol=0, atol=1e-6)
    assert recording_of(replace(config, scene_half_extent=0.0)).scene_box is None


SCALED = np.diag([2.0, 2, 2, 1]).tolist()
CALIB, POSES, VIEWS = "camera_calibration.npz", "camera_poses.npz", "views/transforms_val.json"
FAULTS = {
    "no calibration": (remove(CALIB), f"{CALIB}: there is no such file"),
    "no poses": (remove(POSES), f"{POSES}: there is no such file"),
    "no events": (remove("raw_events.npz"), "raw_events.npz: there is no such file"),
    "no intrinsics": (edit_npz(CALIB, intrinsics=None), f"{CALIB}: it has no array intrinsics"),
    "flat intrinsics": (edit_npz(CALIB, intrinsics=np.ones(9)), r"intrinsics has type float64 and shape \(9,\)"),
    "words as intrinsics": (edit_npz(CALIB, intrinsics=np.full((3, 3), "f")), "intrinsics has type <U1"),
    "unknown distortion": (edit_npz(CALIB, distortion_model="fov"), "the lens model is 'fov', not one of"),
    "three distortions": (edit_npz(CALIB, distortion_params=np.zeros(6)), "takes 5 numbers, not 6"),
    "no focal length": (edit_npz(CALIB, intrinsics=np.zeros((3, 3))), "fx must be from 0.01"),
    "NaN principal point": (edit_npz(CALIB, intrinsics=np.full((3, 3), np.nan)), "fx must be from 0.01"),
    "NaN threshold": (edit_npz(CALIB, pos_contrast_threshold=np.nan), "is not finite"),
    "negative threshold": (edit_npz(CALIB, neg_contrast_threshold=-1.0), "negative_contrast_threshold must be"),
    "unknown pattern": (edit_npz(CALIB, bayer_pattern="GRBG"), '"GRBG"'),
    "pattern is a number": (edit_npz(CALIB, bayer_pattern=3), "bayer_pattern has type int64"),
    "NaN pose": (edit_npz(POSES, T_wc_position=np.full((N_POSES, 3), np.nan)), "pose 0 holds nan"),
    "long quaternion": (edit_npz(POSES, T_wc_orientation=np.ones((N_POSES, 4))), "pose 0 has length 2"),
    "decimal times": (edit_npz(POSES, T_wc_timestamp=np.zeros(N_POSES)), "T_wc_timestamp has type float64"),
    "fewer times": (edit_npz(POSES, T_wc_timestamp=np.arange(3)), "21 positions, 21 orientations and 3 times"),
    "unsorted poses": (edit_npz(POSES, T_wc_timestamp=np.arange(N_POSES)[::-1]), "not after the pose ahead of it"),
    "no overlap": (edit_npz(POSES, T_wc_timestamp=np.arange(N_POSES) + 10**15), "do not overlap the events"),
    "views are no JSON": (write_text(VIEWS, "{"), f"{VIEWS}: not valid JSON"),
    "no frames": (write_text(VIEWS, "{}"), "required field `frames`"),
    "frame is a number": (write_text(VIEWS, '{"frames": [3]}'), r"frames\[0\]: expected `object`, got `int`"),
    "no image": (remove("views/val/r_1.png"), r"frames\[1\] names ./val/r_1, which is no PNG"),
    "scaled pose": (
        edit_json(VIEWS, lambda m: m["frames"][0].update(transform_matrix=SCALED)),
        "is not a rigid motion",
    ),
    "no pose": (edit_json(VIEWS, lambda m: m["frames"][0].pop("transform_matrix")), "field `transform_matrix`"),
    "no angle": (edit_json(VIEWS, lambda m: m.pop("camera_angle_x")), "neither camera_angle_x nor intrinsics"),
    "angle is 0": (edit_json(VIEWS, lambda m: m.update(camera_angle_x=0)), "camera_angle_x: expected `float` > 0"),
    "other angle": (edit_json(VIEWS, lambda m: m.update(camera_angle_x=1)), "is not that of the other split"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_malformed_datasets_are_one_clear_line(fault: str, tmp_path: Path) -> None:
    change, message = FAULTS[fault]
    config = config_of("robust-enerf-data", write_robust_enerf(tmp_path / "made").data)
    assert_one_clear_line(change, message, config)
