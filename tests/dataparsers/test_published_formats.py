"""What TUM-VIE, EDS and the formats of EventNeRF, PAEv3D and Robust e-NeRF each have alone."""

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
    assert_same_poses,
    config_of,
    make_poses,
    recording_of,
    tum_vie_matrix,
    write_eds,
    write_eventnerf,
    write_paev3d,
    write_robust_enerf,
    write_tum_vie,
)
from helpers.small_datasets import parse
from helpers.streams import unpacked

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.cli.convert import Convert
from aenerf_ns.dataparsers.formats import recognize
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.dataparsers.paev3d import PAEv3DDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.tum_trajectory import write_tum_trajectory
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.scene import SCENE_KEY


def test_eds_views_are_those_of_the_frame_camera(tmp_path: Path) -> None:
    truth = write_eds(tmp_path / "made")
    (tmp_path / "chain.yaml").write_text(yaml.dump(CAMCHAIN))
    given = recording_of(config_of("eds-data", truth.data, calibration=tmp_path / "chain.yaml"))
    assert (given.event_camera.fx, given.frame_camera.fx) == (50.0, 70.0)
    view = given.reference_views["train"][1]
    assert view.time == (EPOCH + 800_000) * 1_000
    # Kalibr's matrix takes points from the frame camera to the event camera.
    expected = truth.poses[truth.times == view.time][0] @ make_poses(3)[2]
    np.testing.assert_allclose(view.camera_to_world.numpy(), expected, rtol=0, atol=1e-9)


def test_eventnerf_splits_and_images(tmp_path: Path) -> None:
    truth = write_eventnerf(tmp_path / "made")
    recording = recording_of(config_of("eventnerf-data", truth.data))
    assert recording.sensor.bayer_pattern == "RGGB"
    num_views = {split: len(views) for split, views in recording.reference_views.items()}
    assert num_views == {"train": 21, "val": 3, "test": 2}
    assert len(config_of("eventnerf-data", truth.data).setup().read_frames()[1]) == 21
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
    with pytest.raises(DataError, match="its 21 poses are from 52 to 52 ns; give an earlier --first-pose-time-ns or"):
        recording_of(config_of("eventnerf-data", truth.data, first_pose_time_ns=52, last_pose_time_ns=52))


def test_the_last_pose_is_at_the_last_event_that_is_kept(tmp_path: Path) -> None:
    truth = write_eventnerf(tmp_path / "made")
    events = {name: np.append(np.repeat(column, 6), column[-1]) for name, column in truth.events.items()}
    events["x"][-1], events["t"][-1] = truth.width, 2 * DURATION
    np.savez(truth.data / "train" / "events" / "test_lego.npz", **events)
    recording = recording_of(config_of("eventnerf-data", truth.data, drop_malformed=True))
    assert recording.trajectory.end == recording.event_file.time_span()[1] == DURATION * 1_000


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


def test_choose_one_of_several_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = write_paev3d(tmp_path / "made")
    for part in ("H5_Files", "Render_info"):
        shutil.copytree(truth.data / part / "Bunny", truth.data / part / "Car")
    with pytest.raises(DataError, match=r"it holds 2 scenes .*H5_Files/Bunny"):
        recording_of(PAEv3DDataParserConfig(data=truth.data))
    one = truth.data / "H5_Files" / "Car"
    assert recognize(one) == "paev3d-data"
    assert recording_of(PAEv3DDataParserConfig(data=one)).event_file.path.parent == one
    monkeypatch.chdir(one)
    assert recognize(Path()) == "paev3d-data"
    with pytest.raises(
        DataError, match=r"event.h5: it belongs to a recording in the format paev3d-data; give the folder"
    ):
        recognize(Path("event.h5"))


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


def test_tum_vie_has_two_calibrations_and_two_sides(tmp_path: Path, tum_vie_calibration: Path) -> None:
    for sequence, side in (("mocap-desk2-cut", "right"), ("office-maze", "left"), ("office-maze", "right")):
        folder = tmp_path / f"{sequence}-{side}"
        truth = write_tum_vie(folder, tum_vie_calibration, sequence, side)
        recording = recording_of(config_of("tum-vie-data", folder / f"{sequence}-events_{side}.h5"))
        assert_same_poses(recording.trajectory.camera_to_worlds, truth.poses)
        assert recording.event_camera.fx == truth.matrix[0, 0]
        assert recording.event_camera.cx == truth.matrix[0, 2] + 0.5
        assert recording.sensor == SensorModel(1.458 * 0.25, 0.25, 1375)
    # The calibration may be one folder up.
    for file in folder.glob("*.json"):
        file.rename(tmp_path / file.name)
    recording_of(config_of("tum-vie-data", folder / "office-maze-events_right.h5"))


def test_tum_vie_views_are_those_of_the_frame_camera(tmp_path: Path, tum_vie_calibration: Path) -> None:
    truth = write_tum_vie(tmp_path / "made", tum_vie_calibration)
    recording = recording_of(config_of("tum-vie-data", truth.data))
    cameras = json.loads((tum_vie_calibration / "camera-calibrationA.json").read_text())["value0"]
    imu_from_frame, _, imu_from_event, _ = map(tum_vie_matrix, cameras["T_imu_cam"])

    for view, time in zip(recording.reference_views["train"], (100_000, 333_333, 1_900_000), strict=True):
        assert view.time == (EPOCH + time) * 1_000
        expected = truth.poses[truth.times == view.time][0] @ np.linalg.inv(imu_from_event) @ imu_from_frame
        np.testing.assert_allclose(view.camera_to_world.numpy(), expected, rtol=0, atol=1e-9)
    assert recording.frame_camera.width == recording.frame_camera.height == 1024
    assert recording.frame_camera.cx == cameras["intrinsics"][0]["intrinsics"]["cx"] + 0.5
    assert [len(recording.reference_views[split]) for split in ("train", "val", "test")] == [3, 2, 1]


def test_gap_of_poses_is_left_out_after_conversion_too(
    tmp_path: Path, tum_vie_calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = write_tum_vie(tmp_path / "made", tum_vie_calibration)
    path = truth.data / "mocap-desk2-vi_gt_data" / "mocap_data.txt"
    header, *rows = path.read_text().splitlines(keepends=True)
    # Poses are 8.3 ms apart: one lost is no gap, a second is.
    path.write_text("".join([header, *rows[:30], *rows[31:61], *rows[181:]]))
    config = config_of("tum-vie-data", truth.data)
    gap = (int(truth.times[60]), int(truth.times[181]))
    folder = tmp_path / "native"
    Convert(truth.data, folder).main()
    capsys.readouterr()
    for parser in (config, NativeDataParserConfig(data=folder)):
        outputs = parse(parser)
        assert (
            " ".join(capsys.readouterr().out.split()).count("The poses have 1 gap(s) of more than 0.05 s, 1.0 s in")
            == 1
        )
        assert outputs.metadata[SCENE_KEY].window.gaps == (gap,)
        pairs = EventDataset(outputs).pairs
        times = truth.events["t"] * 1_000
        assert pairs.num_outside == int(((times > gap[0]) & (times < gap[1])).sum()) > 50
        intervals = [pair[2:4] for pair in unpacked(pairs)]
        assert all(end <= gap[0] or begin >= gap[1] for begin, end in intervals)
        assert any(end <= gap[0] for _, end in intervals)
        assert any(begin >= gap[1] for begin, _ in intervals)
    # An image in the gap has no pose: here none of the three, so one is moved there.
    stamps = truth.data / "mocap-desk2-vi_gt_data" / "left_images" / "image_timestamps_left.txt"
    stamps.write_text(f"{EPOCH + 100_000}\n{EPOCH + 900_000}\n{EPOCH + 1_900_000}\n")
    views = recording_of(config).reference_views["train"]
    assert [view.file.name for view in views] == ["00000.jpg", "00002.jpg"]
    # Poses that are given in place of the motion capture have gaps of their own.
    write_tum_trajectory(tmp_path / "slow.txt", Trajectory(truth.times[::30], torch.from_numpy(truth.poses[::30])))
    given = replace(config, trajectory=tmp_path / "slow.txt")
    assert parse(given).metadata[SCENE_KEY].window.gaps == ()
    assert recording_of(given).ground_truth is not None
    # Another limit may be given.
    assert parse(replace(config, max_pose_gap_ns=2 * 10**9)).metadata[SCENE_KEY].window.gaps == ()


def test_choose_one_of_several_sequences(tmp_path: Path, tum_vie_calibration: Path) -> None:
    for sequence in ("mocap-desk2", "office-maze"):
        write_tum_vie(tmp_path / "made", tum_vie_calibration, sequence)
    with pytest.raises(DataError, match=r"it holds 2 sequences .*/mocap-desk2-events_left.h5"):
        recording_of(config_of("tum-vie-data", tmp_path / "made"))
    one = tmp_path / "made" / "office-maze-events_left.h5"
    assert recognize(one) == "tum-vie-data"
    assert recording_of(config_of("tum-vie-data", one)).event_file.path == one
