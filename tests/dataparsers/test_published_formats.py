"""What EDS and the formats of EventNeRF, PAEv3D and Robust e-NeRF each have alone."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from helpers.published_datasets import (
    CAMCHAIN,
    DURATION,
    EPOCH,
    config_of,
    interpolated,
    make_poses,
    recording_of,
    write_eds,
    write_eventnerf,
    write_paev3d,
    write_robust_enerf,
)
from helpers.small_datasets import parse

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.dataparsers.formats import recognize
from aenerf_ns.dataparsers.paev3d import PAEv3DDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.dataset import EventDataset


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


def test_poses_run_no_code(tmp_path: Path) -> None:
    truth = write_paev3d(tmp_path / "made")
    file = truth.data / "Render_info" / "Bunny" / "0003.npz"

    class Harm:
        def __reduce__(self) -> tuple:
            return os.mkdir, (str(tmp_path / "harm"),)

    np.savez(file, object_poses=np.array([Harm()], dtype=object))
    with pytest.raises(DataError, match=r"0003.npz: not a readable array object_poses .it asks for posix.mkdir"):
        recording_of(PAEv3DDataParserConfig(data=truth.data))
    assert not (tmp_path / "harm").exists()


def test_choose_one_of_several_scenes(tmp_path: Path) -> None:
    truth = write_paev3d(tmp_path / "made")
    for part in ("H5_Files", "Render_info"):
        shutil.copytree(truth.data / part / "Bunny", truth.data / part / "Car")
    with pytest.raises(DataError, match=r"it holds 2 scenes .*H5_Files/Bunny"):
        recording_of(PAEv3DDataParserConfig(data=truth.data))
    one = truth.data / "H5_Files" / "Car"
    assert recognize(one) == "paev3d-data"
    assert recording_of(PAEv3DDataParserConfig(data=one)).event_file.path.parent == one


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
