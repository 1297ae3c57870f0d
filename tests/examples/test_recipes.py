"""The scripts that make recordings of published datasets, on small files of their layouts. JSON is YAML too."""

import json
import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.bag_writers import message_header, string, typestore
from helpers.examples import run_example
from helpers.published_datasets import (
    EPOCH,
    N_POSES,
    assert_same_poses,
    make_events,
    make_poses,
    recording_of,
    write_poses,
)
from numpy.typing import NDArray
from PIL import Image

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.dataparsers.own_recording import OwnRecordingDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.recording.recording import Recording

# Seconds since 1970, as the datasets have them.
TIMES = EPOCH / 1e6 + np.linspace(0, 2, N_POSES)


def assert_same_events(recording: Recording, expected: dict[str, NDArray]) -> None:
    (found,) = recording.event_file.chunks()
    for name in "xyp":
        np.testing.assert_array_equal(getattr(found, name), expected[name])
    # A float64 holds Unix time to a quarter of a microsecond.
    np.testing.assert_allclose(found.t - EPOCH * 1_000, (expected["t"] - EPOCH) * 1_000, rtol=0, atol=250)


def test_mvsec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    events = make_events(346, 260, EPOCH)
    with h5py.File("indoor_flying1_data.hdf5", "w") as file:
        file["davis/left/events"] = np.stack([events["x"], events["y"], events["t"] / 1e6, events["p"]], 1)
        file["davis/left/image_raw"] = np.full((2, 260, 346), 9, np.uint8)
        file["davis/left/image_raw_ts"] = TIMES[[5, 10]]
    with h5py.File("indoor_flying1_gt.hdf5", "w") as file:
        file["davis/left/pose"], file["davis/left/pose_ts"] = make_poses(), TIMES
    camera = {
        "camera_model": "pinhole",
        "distortion_model": "equidistant",
        "intrinsics": [226.4, 226.1, 173.6, 133.7],
        "resolution": [346, 260],
        "distortion_coeffs": [-0.05, -0.01, 0.02, -0.01],
    }
    chain = {"T_cam0_lidar": np.eye(4).tolist(), "cam0": camera, "cam1": {**camera, "T_cn_cnm1": np.eye(4).tolist()}}
    Path("indoor_flying_calib").mkdir()
    Path("indoor_flying_calib/camchain-imucam-indoor_flying.yaml").write_text(json.dumps(chain))
    run_example("mvsec_to_recording")
    options: dict[str, Any] = {"data": Path("mvsec"), "event_camera": "cam0", "frame_camera": "cam0"}
    recording = recording_of(OwnRecordingDataParserConfig(**options))
    assert_same_events(recording, events)
    assert_same_poses(recording.trajectory.camera_to_worlds, make_poses())
    lens = CameraIntrinsics(346, 260, 226.4, 226.1, 174.1, 134.2, "fisheye", (-0.05, -0.01, 0.02, -0.01))
    assert recording.event_camera == recording.frame_camera == lens
    (view,) = recording.reference_views["test"]
    np.testing.assert_allclose(view.camera_to_world.numpy(), make_poses()[10], rtol=0, atol=1e-6)
    assert np.asarray(Image.open(view.file)).tolist() == np.full((260, 346), 9).tolist()
    # Poses that DEVO estimated of it.
    estimated = make_poses()
    estimated[:, :3, 3] *= 0.1
    header = "# timestamp[secs] tx ty tz qx qy qz qw\n"
    write_poses(Path("estimate.txt"), estimated, [repr(float(time)) for time in TIMES], header)
    recording = recording_of(OwnRecordingDataParserConfig(**options, trajectory=Path("estimate.txt")))
    assert_same_poses(recording.trajectory.camera_to_worlds, estimated)
    assert recording.ground_truth is not None
    assert_same_poses(recording.ground_truth.camera_to_worlds, make_poses())
    # The other file of a run has microseconds.
    write_poses(Path("estimate.txt"), estimated, [repr(float(time * 1e6)) for time in TIMES])
    with pytest.raises(DataError, match=r"estimate\.txt: 1600000000000000\.0 is not a time in seconds; write plain"):
        OwnRecordingDataParserConfig(**options, trajectory=Path("estimate.txt")).setup().get_dataparser_outputs("train")


def test_vector(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    events = make_events(640, 480, EPOCH)
    with h5py.File("corner_slow1.synced.left_event.hdf5", "w") as file:
        for name, values in events.items():
            column = {"t": values - EPOCH, "p": values > 0}.get(name, values)
            file[f"events/{name}"] = column.astype({"t": "u4", "p": "u1"}.get(name, "u2"))
        file["t_offset"] = np.array([EPOCH])
    camera_from_body, camera_from_event = make_poses(5)[[1, 3]]
    header = "# ground truth for corner_slow1\n# timestamp tx ty tz qx qy qz qw\n"
    body = make_poses() @ np.linalg.inv(camera_from_event) @ camera_from_body
    write_poses(Path("corner_slow1.synced.gt.txt"), body, [f"{time:.6f}" for time in TIMES], header)
    lens = {
        "camera_matrix": {"rows": 3, "cols": 3, "data": [327.0, 0, 304.5, 0, 328.0, 235.0, 0, 0, 1]},
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.03, 0.02, 0.001, -0.002, 0.1]},
    }
    for name, content in (
        ("left_event_camera_intrinsic_results", lens),
        ("camera_mocap_extrinsic_results1", {"cam0": {"T_cam_body": camera_from_body.flatten().tolist()}}),
        ("small_scale_joint_camera_extrinsic_results", {"cam2": {"T_cam0_cam2": camera_from_event.tolist()}}),
    ):
        Path(f"{name}.yaml").write_text(json.dumps(content))
    run_example("vector_to_recording")
    options = {"data": Path("vector"), "events": Path("corner_slow1.synced.left_event.hdf5")}
    recording = recording_of(OwnRecordingDataParserConfig(**options))
    assert_same_events(recording, events)
    assert_same_poses(recording.trajectory.camera_to_worlds, make_poses())
    expected = CameraIntrinsics(640, 480, 327.0, 328.0, 305.0, 235.5, distortion=(-0.03, 0.02, 0.001, -0.002, 0.1))
    assert recording.event_camera == expected


@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "bgr8"])
def test_frames_of_a_bag(encoding: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    monkeypatch.chdir(tmp_path)
    Path("recording").mkdir()
    # Two frames of 3 x 2 gray pixels or 1 x 2 colors, whose rows are padded to 4 bytes. images/ is there already.
    Path("recording/images").mkdir()
    frames = np.arange(16, dtype=np.uint8).reshape(2, 2, 4)
    stamps = [EPOCH * 1_000 + 7, EPOCH * 1_000 + 40_000_007]
    with rosbag1.Writer(Path("recording/events.bag")) as writer:
        pictures = writer.add_connection("/dvs/image_raw", "sensor_msgs/msg/Image", typestore=typestore("ROS1_NOETIC"))
        for stamp, frame in zip(stamps, frames, strict=True):
            end = string(encoding) + b"\0" + struct.pack("<2I", 4, frame.size) + frame.tobytes()
            writer.write(pictures, stamp, message_header(stamp, (3 if encoding == "mono8" else 1, 2)) + end)
    run_example("frames_of_a_bag")
    lines = Path("recording/images.txt").read_text().splitlines()
    assert lines == ["1600000000.000000007 images/000000.png", "1600000000.040000007 images/000001.png"]
    for index, frame in enumerate(frames):
        values = frame[:, :3] if encoding == "mono8" else frame[:, None, :3][..., :: -1 if encoding == "bgr8" else 1]
        np.testing.assert_array_equal(Image.open(f"recording/images/{index:06d}.png"), values)
