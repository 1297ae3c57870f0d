"""The native dataset format."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.small_datasets import AS_RECORDED, CAMERA, SENSOR, START, make_trajectory, parse
from helpers.streams import make_stream

from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, homogeneous
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.event_hdf5 import Hdf5EventWriter
from aenerf_ns.files.text import format_seconds
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.scene import SCENE_KEY


def test_written_dataset_reads_back(native: Path) -> None:
    scene = parse(NativeDataParserConfig(data=native, **AS_RECORDED)).metadata[SCENE_KEY]
    assert (scene.event_camera, scene.sensor, scene.image_encoding) == (CAMERA, SENSOR, "srgb")
    assert not scene.bounded
    expected = make_trajectory()
    assert torch.equal(scene.trajectory.times, expected.times)
    poses = expected.camera_to_worlds @ OPENCV_TO_OPENGL
    torch.testing.assert_close(scene.trajectory.camera_to_worlds, poses, rtol=0, atol=1e-11)
    for split, values in (("val", [77]), ("test", [78, 79])):
        dataset = EventDataset(parse(NativeDataParserConfig(data=native), split))
        assert [int(dataset.get_numpy_image(i)[0, 0, 0]) for i in range(len(dataset))] == values
    events = list(scene.event_file.chunks())
    assert sum(map(len, events)) == scene.event_file.count() == 200
    assert scene.event_file.time_span() == (events[0].t[0], events[-1].t[-1])


def test_frame_without_pose_gets_that_of_its_time(native: Path) -> None:
    meta = json.loads((native / "transforms.json").read_text())
    time = START + 150_000_000
    for frame in meta["frames"]:
        if frame["file_path"] == meta["test_filenames"][0]:
            del frame["transform_matrix"]
            frame["timestamp"] = "STAMP"
    shift = np.eye(4)
    shift[0, 3] = 0.5
    meta["event_camera"]["T_frame_event"] = shift.tolist()
    # Every digit of the time counts, beyond what a JSON writer's float holds.
    (native / "transforms.json").write_text(json.dumps(meta).replace('"STAMP"', format_seconds(time)))
    pose = parse(NativeDataParserConfig(data=native, **AS_RECORDED), "test").cameras.camera_to_worlds[0]
    expected = homogeneous(make_trajectory().interpolate(time)) @ torch.linalg.inv(torch.from_numpy(shift))
    torch.testing.assert_close(pose, (expected @ OPENCV_TO_OPENGL)[:3].float(), rtol=0, atol=1e-6)
    # In a gap of the true poses it has none.
    truth = native / "trajectory_ground_truth.txt"
    lines = truth.read_text().splitlines()
    truth.write_text("\n".join(lines[:2] + lines[9:]))
    assert len(parse(NativeDataParserConfig(data=native), "test").cameras) == 1


def test_frames_of_one_time_are_refused_where_poses_are_missing(native: Path) -> None:
    meta = json.loads((native / "transforms.json").read_text())
    for frame in meta["frames"]:
        frame["timestamp"] = 7.5
    (native / "transforms.json").write_text(json.dumps(meta))
    (native / "trajectory_estimated.txt").unlink()
    with pytest.raises(DataError, match=r"several images are at 7\.500000000 s; give each image its own time"):
        NativeDataParserConfig(data=native).setup().read_frames()


def test_options_replace_values_of_the_sensor(native: Path) -> None:
    options = {"positive_contrast_threshold": 0.7, "refractory_period_ns": 0, "bandwidth_hz": 0.0}
    scene = parse(NativeDataParserConfig(data=native, **options)).metadata[SCENE_KEY]
    assert scene.sensor == SensorModel(0.7, 0.2, 0, "RGGB")
    with pytest.raises(DataError, match=r"positive_contrast_threshold must be from 0.0001 to 1000, not 0; .*options"):
        parse(NativeDataParserConfig(data=native, positive_contrast_threshold=0.0))


def test_refuse_to_write_events_out_of_order(tmp_path: Path) -> None:
    with Hdf5EventWriter(tmp_path / "events.h5") as writer:
        writer.append(make_stream([(0, 0, 5, 1)]))
        with pytest.raises(DataError, match="4 ns is before 5 ns"):
            writer.append(make_stream([(0, 0, 4, 1)]))
