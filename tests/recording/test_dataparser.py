"""Reading datasets: round trips, the real recording, and malformed input."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from conftest import make_stream
from small_datasets import (
    AS_RECORDED,
    CAMERA,
    ECD_FAULTS,
    END,
    NATIVE_FAULTS,
    SENSOR,
    START,
    make_trajectory,
    parse,
    read_everything,
    replace_line,
    write_ecd,
    write_native,
)

from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.ray_tags import REFERENCE_SECONDS
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous
from aenerf_ns.dataparsers.ecd import EcdDataParserConfig
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.time_window import TimeWindow
from aenerf_ns.files.event_hdf5 import Hdf5EventFile, Hdf5EventWriter
from aenerf_ns.files.text import format_seconds, parse_times
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.scene import SCENE
from aenerf_ns.recording.writer import NativeDatasetWriter


def test_a_written_dataset_reads_back(tmp_path: Path) -> None:
    folder = write_native(tmp_path / "made")
    outputs = parse(NativeDataParserConfig(data=folder, **AS_RECORDED))
    metadata = outputs.metadata
    assert metadata[SCENE].event_camera == CAMERA
    assert metadata[SCENE].sensor == SENSOR
    assert metadata[SCENE].image_encoding == "srgb"
    assert not metadata[SCENE].bounded
    expected = make_trajectory()
    assert torch.equal(metadata[SCENE].trajectory.times, expected.times)
    torch.testing.assert_close(
        metadata[SCENE].trajectory.camera_to_worlds,
        (homogeneous(expected.camera_to_worlds) @ OPENCV_TO_OPENGL)[:, :3],
        rtol=0,
        atol=1e-11,
    )
    for split, values in (("val", [77]), ("test", [78, 79])):
        dataset = EventDataset(parse(NativeDataParserConfig(data=folder), split))
        assert [int(dataset.get_numpy_image(i)[0, 0, 0]) for i in range(len(dataset))] == values
    events = list(metadata[SCENE].event_file.chunks())
    assert sum(map(len, events)) == metadata[SCENE].event_file.count() == 200
    assert metadata[SCENE].event_file.time_span() == (events[0].t[0], events[-1].t[-1])


def test_all_splits_share_one_world_and_the_transform_is_the_one_reported(tmp_path: Path) -> None:
    folder = write_native(tmp_path / "made")
    config = NativeDataParserConfig(data=folder)
    train, test = parse(config), parse(config, "test")
    assert train.dataparser_scale == test.dataparser_scale
    assert torch.equal(train.dataparser_transform, test.dataparser_transform)
    original = train.transform_poses_to_original_space(test.cameras.camera_to_worlds, "opencv")
    torch.testing.assert_close(original, make_trajectory().camera_to_worlds[[4, 5]].float(), rtol=0, atol=1e-5)
    # The framework's convention: cameras fit in a box of +/- 1 about the origin.
    assert train.metadata[SCENE].trajectory.camera_to_worlds[:, :, 3].abs().max().item() == pytest.approx(1.0, rel=1e-2)


def test_a_scene_box_sets_the_scale_and_bounds_the_scene(tmp_path: Path) -> None:
    folder = write_native(tmp_path / "made", np.array([[-1.0, -2.0, 0.0], [3.0, 4.0, 1.0]]))
    outputs = parse(NativeDataParserConfig(data=folder))
    assert outputs.metadata[SCENE].bounded
    torch.testing.assert_close(outputs.scene_box.aabb, torch.tensor([[-2 / 3, -1, -1 / 6], [2 / 3, 1, 1 / 6]]))
    first = outputs.metadata[SCENE].trajectory.camera_to_worlds[0, :, 3]
    torch.testing.assert_close(first, torch.tensor([-1.0, -1.0, 1.5], dtype=torch.float64) / 3)


def test_training_cameras_show_images_where_they_were_taken_and_events_elsewhere(tmp_path: Path) -> None:
    dataset = EventDataset(parse(NativeDataParserConfig(data=write_native(tmp_path / "made"))))
    has_image = dataset.metadata[SCENE].has_image
    # Knots, of which two are also image times, and one image between two knots.
    assert len(dataset) == 22
    assert [i for i, image in enumerate(has_image) if image] == [0, 2, 21]
    assert (dataset.get_numpy_image(2) == 77).all()
    picture = dataset.get_numpy_image(10)
    assert picture.shape == (4, 6, 3)
    assert (picture.max(-1) != picture.min(-1)).any()


def test_the_time_window_leaves_out_events_poses_and_images(tmp_path: Path) -> None:
    folder = write_native(tmp_path / "made")
    start, end = START + 500_000_000, START + 1_050_000_000
    dataset = EventDataset(parse(NativeDataParserConfig(data=folder, start_time_ns=start, end_time_ns=end)))
    trajectory = dataset.metadata[SCENE].trajectory
    assert (trajectory.start, trajectory.end) == (start, START + 1_100_000_000)
    assert not any(dataset.metadata[SCENE].has_image)
    assert dataset.pairs.previous_time.min() >= start
    assert dataset.pairs.time.max() <= end
    assert dataset.pairs.num_outside > 0
    # What lies outside the poses is no part of the window either.
    config = NativeDataParserConfig(data=folder, start_time_ns=0, end_time_ns=END + 10**12)
    assert parse(config).metadata[SCENE].window == TimeWindow(START, END)
    with pytest.raises(DataError, match="nothing is left from 9 to 9 ns"):
        parse(NativeDataParserConfig(data=folder, start_time_ns=9, end_time_ns=9))


def test_opening_again_with_the_resolved_window_needs_no_events(tmp_path: Path) -> None:
    folder = write_native(tmp_path / "made")
    config = NativeDataParserConfig(data=folder)
    before = parse(config)
    assert config.start_time_ns is not None
    (folder / "events.h5").unlink()
    after = parse(config)
    assert torch.equal(before.cameras.camera_to_worlds, after.cameras.camera_to_worlds)
    # The viewer shows plain pictures then.
    assert EventDataset(after).get_numpy_image(10).std() == 0


def test_a_frame_without_a_pose_gets_that_of_its_time(tmp_path: Path) -> None:
    folder = write_native(tmp_path / "made")
    meta = json.loads((folder / "transforms.json").read_text())
    time = START + 150_000_000
    for frame in meta["frames"]:
        if frame["file_path"] == meta["test_filenames"][0]:
            del frame["transform_matrix"]
            frame["timestamp"] = "STAMP"
    shift = np.eye(4)
    shift[0, 3] = 0.5
    meta["event_camera"]["T_frame_event"] = shift.tolist()
    # Every digit of the time counts, beyond what a JSON writer's float holds.
    (folder / "transforms.json").write_text(json.dumps(meta).replace('"STAMP"', format_seconds(time)))
    config = NativeDataParserConfig(
        data=folder, orientation_method="none", center_method="none", auto_scale_poses=False
    )
    pose = parse(config, "test").cameras.camera_to_worlds[0]
    expected = homogeneous(make_trajectory().interpolate(time)) @ torch.linalg.inv(torch.from_numpy(shift))
    torch.testing.assert_close(pose, (expected @ OPENCV_TO_OPENGL)[:3].float(), rtol=0, atol=1e-6)


def test_nothing_is_left_of_a_dataset_that_could_not_be_completed(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), NativeDatasetWriter(tmp_path / "made", CAMERA, SENSOR, "srgb"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with (
        pytest.raises(ValueError, match="no trajectory"),
        NativeDatasetWriter(tmp_path / "made", CAMERA, SENSOR, "srgb"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
    write_native(tmp_path / "made")
    with pytest.raises(DataError, match="made: the folder exists already"):
        NativeDatasetWriter(tmp_path / "made", CAMERA, SENSOR, "srgb")


def test_options_take_the_place_of_the_sensors_values(tmp_path: Path) -> None:
    folder = write_native(tmp_path / "made")
    options = {"positive_contrast_threshold": 0.7, "refractory_period_ns": 0}
    assert parse(NativeDataParserConfig(data=folder, **options)).metadata[SCENE].sensor == SensorModel(
        0.7, 0.2, 0, "RGGB"
    )
    with pytest.raises(DataError, match=r"positive_contrast_threshold must be a positive number, not 0\.0; .*options"):
        parse(NativeDataParserConfig(data=folder, positive_contrast_threshold=0.0))


def test_reference_views_far_from_the_estimated_poses_are_refused(tmp_path: Path) -> None:
    # True poses in a geodetic frame: single precision, which the framework's cameras have, would displace them.
    folder = write_native(tmp_path / "scene")
    truth = make_trajectory()
    far = Trajectory(truth.times, truth.camera_to_worlds + torch.tensor([[0, 0, 0, 4e5]], dtype=torch.float64))
    write_tum_trajectory(folder / "trajectory_ground_truth.txt", far)
    transforms = json.loads((folder / "transforms.json").read_text())
    for frame in transforms["frames"]:
        frame["transform_matrix"][0][3] += 4e5
    (folder / "transforms.json").write_text(json.dumps(transforms))
    config = NativeDataParserConfig(data=folder)
    assert len(parse(config, "train").image_filenames)
    with pytest.raises(
        DataError, match=r"ground_truth.txt: a reference view is .* times as far .*; subtract one offset"
    ):
        parse(config, "test")


def test_a_camera_that_only_turns_gives_no_scale(tmp_path: Path) -> None:
    folder = write_ecd(tmp_path / "made")
    (folder / "groundtruth.txt").write_text("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n")
    parse(EcdDataParserConfig(data=folder))
    with pytest.raises(DataError, match="--auto-scale-poses False"):
        parse(EcdDataParserConfig(data=folder, auto_scale_poses=True))


def test_events_are_written_in_order_only(tmp_path: Path) -> None:
    with Hdf5EventWriter(tmp_path / "events.h5") as writer:
        writer.append(make_stream([(0, 0, 5, 1)]))
        with pytest.raises(DataError, match="4 ns is before 5 ns"):
            writer.append(make_stream([(0, 0, 4, 1)]))


def test_tum_trajectories_round_trip_to_the_nanosecond(tmp_path: Path) -> None:
    trajectory = make_trajectory()
    write_tum_trajectory(tmp_path / "poses.txt", trajectory)
    back = read_tum_trajectory(tmp_path / "poses.txt")
    assert torch.equal(back.times, trajectory.times)
    torch.testing.assert_close(back.camera_to_worlds, trajectory.camera_to_worlds, rtol=0, atol=1e-11)


def test_seconds_are_parsed_and_printed_exactly() -> None:
    texts = ["1600000000.123456789", "0", "1e-9", "-0.5", "12."]
    parsed = parse_times(Path("t"), texts)
    assert parsed.tolist() == [1_600_000_000_123_456_789, 0, 1, -500_000_000, 12_000_000_000]
    assert parse_times(Path("t"), [format_seconds(int(t)) for t in parsed]).tolist() == parsed.tolist()


def test_ecd_text_reads(tmp_path: Path) -> None:
    config = EcdDataParserConfig(data=write_ecd(tmp_path / "made"))
    dataset = EventDataset(parse(config))
    camera = dataset.metadata[SCENE].event_camera
    # The format counts the principal point from the centre of the first pixel.
    assert (camera.width, camera.height, camera.cx, camera.cy) == (6, 4, 3.0, 2.0)
    (chunk,) = dataset.metadata[SCENE].event_file.chunks()
    assert chunk.t.tolist() == [10_000_000, 20_000_000, 30_000_000, 310_000_000]
    assert chunk.p.tolist() == [1, -1, 1, 1]
    assert dataset.metadata[SCENE].window == TimeWindow(10_000_000, 310_000_000)
    assert dataset.pairs.time.tolist() == [20_000_000, 310_000_000]
    # Images at 0.05 and 0.25 s validate, 0.15 s tests, 0.35 s is after the last event.
    assert len(parse(config, "val").image_filenames) == 2
    assert len(parse(config, "test").image_filenames) == 1


def test_ecd_text_may_be_given_other_poses(tmp_path: Path) -> None:
    folder = write_ecd(tmp_path / "made")
    truth = read_tum_trajectory(folder / "groundtruth.txt")
    other = perturb(truth, rotation_degrees=2.0, translation=0.1, correlation_time=0.1, seed=0)
    write_tum_trajectory(tmp_path / "other.txt", other)
    config = EcdDataParserConfig(data=folder, trajectory=tmp_path / "other.txt")
    outputs, as_given = parse(config), parse(EcdDataParserConfig(data=folder))
    assert as_given.metadata[SCENE].ground_truth is None
    # In the scene's frame, which follows from the estimated poses; images have true ones.
    to_scene = homogeneous(outputs.dataparser_transform.double())
    for name, poses in (("ground_truth", truth), ("trajectory", other)):
        times = getattr(outputs.metadata[SCENE], name).times
        expected = to_scene @ homogeneous(poses.interpolate(times)) @ OPENCV_TO_OPENGL
        torch.testing.assert_close(
            getattr(outputs.metadata[SCENE], name).camera_to_worlds, expected[:, :3], rtol=0, atol=1e-6
        )
    views = parse(config, "test").cameras
    expected = to_scene @ homogeneous(truth.interpolate([150_000_000])) @ OPENCV_TO_OPENGL
    torch.testing.assert_close(views.camera_to_worlds, expected[:, :3].float(), rtol=0, atol=1e-6)
    assert views.metadata is not None
    taken = views.metadata[REFERENCE_SECONDS][0, 0].item()
    assert taken == pytest.approx(0.15 - 1e-9 * outputs.metadata[SCENE].trajectory.start)


def test_ecd_text_may_hold_comments_and_empty_lines(tmp_path: Path) -> None:
    folder = write_ecd(tmp_path / "made")
    events = folder / "events.txt"
    events.write_text("# t x y p\n\n" + events.read_text() + "\n\n")
    dataset = EventDataset(parse(EcdDataParserConfig(data=folder)))
    assert dataset.metadata[SCENE].window == TimeWindow(10_000_000, 310_000_000)
    assert dataset.pairs.num_events == 4
    replace_line("events.txt", 4, "0.03 9 3 1")(folder)
    with pytest.raises(DataError, match="line 5 has x = 9"):
        list(dataset.metadata[SCENE].event_file.chunks())


def test_the_real_recording_reads(slider_depth: Path) -> None:
    config = EcdDataParserConfig(data=slider_depth)
    dataset = EventDataset(parse(config))
    pairs = dataset.pairs
    assert pairs.num_events == 50_000
    # The first pose is at 0.0223 s, the events begin at 0.0038 s.
    assert dataset.metadata[SCENE].window == TimeWindow(22_291_582, 174_156_000)
    assert pairs.num_outside == 3_251
    assert len(pairs) + pairs.num_first + pairs.num_outside + pairs.num_merged == 50_000
    assert len(parse(config, "test").image_filenames) == 2
    # A linear slider: straight on, no turn.
    poses = dataset.metadata[SCENE].trajectory.camera_to_worlds
    assert (poses[:, :, :3] - poses[:1, :, :3]).abs().max() < 1e-6
    assert torch.linalg.matrix_rank(poses[1:, :, 3] - poses[0, :, 3], atol=1e-4) == 1


@pytest.mark.parametrize("fault", ECD_FAULTS)
def test_malformed_ecd_text_is_one_clear_line(fault: str, tmp_path: Path) -> None:
    folder = write_ecd(tmp_path / "made")
    change, message = ECD_FAULTS[fault]
    change(folder)
    with pytest.raises(DataError, match=message) as error:
        read_everything(EcdDataParserConfig(data=folder))
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)


@pytest.mark.parametrize("fault", NATIVE_FAULTS)
def test_malformed_native_datasets_are_one_clear_line(fault: str, tmp_path: Path) -> None:
    folder = write_native(tmp_path / "made")
    change, message = NATIVE_FAULTS[fault]
    change(folder)
    with pytest.raises(DataError, match=message) as error:
        read_everything(NativeDataParserConfig(data=folder))
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)


def test_times_in_other_units_with_an_offset(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "events.h5", "w") as file:
        for name, dtype in (("x", np.uint16), ("y", np.uint16), ("p", np.int8)):
            file[f"events/{name}"] = np.ones(3, dtype)
        file["events/t"] = np.array([1, 2, 5])
        # As some writers store a string.
        file["events"].attrs["time_unit"] = np.array([b"us"])
        file["events"].attrs["time_offset"] = 1000
    events = Hdf5EventFile(tmp_path / "events.h5", 2, 2)
    (chunk,) = events.chunks()
    assert chunk.t.tolist() == [1_001_000, 1_002_000, 1_005_000]
    assert events.time_span() == (1_001_000, 1_005_000)
