"""The user's own recording: events, calibration and poses from any source."""

import json
import struct
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from helpers.event_file_writers import HEIGHT, WIDTH, evt3
from helpers.own_recordings import random_events, write_poses
from helpers.published_datasets import (
    CALIBRATION,
    CAMCHAIN,
    EPOCH,
    Truth,
    assert_same_poses,
    make_poses,
    recording_of,
    write_colmap,
    write_own,
)
from helpers.small_datasets import make_trajectory

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.dataparsers.formats import recognize
from aenerf_ns.dataparsers.own_recording import OwnRecordingDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.calibration import read_calibration
from aenerf_ns.recording.recording import Recording
from aenerf_ns.recording.views import views_on_trajectory


@pytest.fixture
def truth(tmp_path: Path) -> Truth:
    """A whole recording."""
    return write_own(tmp_path / "made")


@pytest.fixture
def placed(truth: Truth) -> Truth:
    """A recording whose poses are those of a COLMAP model."""
    (truth.data / "trajectory.txt").unlink()
    write_colmap(truth.data / "colmap", truth.poses[[0, 5, 10]], [f"{index:05d}.png" for index in range(3)])
    return truth


def opened(truth: Truth, **options: object) -> Recording:
    return recording_of(OwnRecordingDataParserConfig(data=truth.data, **options))


def test_own_recordings_have_views_at_their_times(truth: Truth) -> None:
    recording = opened(truth)
    assert recording.sensor == SensorModel(0.3, 0.2, 100)
    assert recording.image_encoding == "linear"
    # The fourth image is after the last pose.
    times = [view.time for view in recording.reference_views["train"]]
    assert [time - EPOCH * 1_000 for time in times] == [0, 5 * 10**8, 10**9]
    # The list may state its unit.
    rows = [line.split() for line in (truth.data / "images.txt").read_text().splitlines()]
    rows = [(int(Decimal(time) * 10**6), name) for time, name in rows]
    for names, separator in (("#timestamp [us],filename", " "), ("timestamp [us],filename", ","), ("t_us file", " ")):
        text = "".join(f"{time}{separator}{name}\n" for time, name in rows)
        (truth.data / "images.txt").write_text(f"{names}\n{text}")
        views = opened(truth).reference_views["train"]
        assert [view.time for view in views] == times
    (truth.data / "images.txt").write_text("".join(f"{name} {time}\n" for time, name in rows))
    with pytest.raises(DataError, match=r"images/00000.png is not a time in seconds; write"):
        opened(truth)
    view = recording.reference_views["test"][0]
    np.testing.assert_allclose(view.camera_to_world.numpy(), truth.poses[5], rtol=0, atol=1e-9)


def test_own_recording_from_files_anywhere(truth: Truth, tmp_path: Path) -> None:
    parts = tmp_path / "parts"
    parts.mkdir()
    (truth.data / "images").rename(parts / "images")
    names = {
        "events": "events.h5", "calibration": "calibration.json", "poses": "trajectory.txt", "images": "images.txt",
    }  # fmt: skip
    options = {option: (truth.data / name).rename(parts / f"mine_{name}") for option, name in names.items()}
    options["calibration"] = options["calibration"].rename(parts / "MINE.JSON")
    recording = recording_of(OwnRecordingDataParserConfig(data=parts, **options))
    assert_same_poses(recording.trajectory.camera_to_worlds, truth.poses)
    assert len(recording.reference_views["train"]) == 3
    assert recording.event_file.time_span()[0] == EPOCH * 1_000


def test_intrinsics_may_be_missing(truth: Truth) -> None:
    file = truth.data / "calibration.json"
    meta = json.loads(file.read_text())
    lens = {"fl_x", "fl_y", "cx", "cy", "k1", "p2"}
    del meta["image_encoding"]
    meta["event_camera"] = {key: value for key, value in meta["event_camera"].items() if key not in lens}
    file.write_text(json.dumps(meta))
    with pytest.raises(DataError, match="it has no camera cam1; give Kalibr's camchain"):
        opened(truth, event_camera="cam1")
    parser = OwnRecordingDataParserConfig(data=truth.data).setup()
    with pytest.raises(DataError, match=r"intrinsics .* are not known; calibrate it, or .* --poses events"):
        parser.get_dataparser_outputs("train")
    # Poses that are given can still be compared with. The last frame is after them.
    recording, frames = parser.read_frames()
    assert isinstance(recording, Recording)
    assert recording.intrinsics_origin == "guessed"
    assert (recording.event_camera.width, recording.event_camera.height) == (60, 40)
    assert recording.sensor == SensorModel(0.3, 0.2, 100)
    assert len(frames) == 4
    assert recording.image_encoding == "linear"
    # A part of a lens is a mistake.
    camera = meta["event_camera"]
    fisheye, matrix = {**camera, "camera_model": "OPENCV_FISHEYE"}, {**camera, "K": []}
    for change in ({"event_camera": fisheye}, {"event_camera": matrix}, {"fl_x": 50.0}):
        file.write_text(json.dumps({**meta, **change}))
        with pytest.raises(DataError, match=r"it states .*, but event_camera has no fl_x, fl_y, cx and cy; state"):
            parser.read_recording()
    meta["event_camera"]["fl_x"] = 50.0
    file.write_text(json.dumps(meta))
    with pytest.raises(DataError, match="missing required field `fl_y`"):
        parser.read_recording()


def test_a_recording_may_be_given_by_its_event_file(truth: Truth) -> None:
    known = opened(truth)
    file = known.event_file.path.rename(truth.data / f"MY{known.event_file.path.suffix.upper()}")
    assert recognize(file) == "event-recording-data"
    config = OwnRecordingDataParserConfig(data=file)
    found = recording_of(config)
    assert found.event_file.path == file
    assert (found.event_camera, found.sensor, found.frames) == (known.event_camera, known.sensor, known.frames)
    assert torch.equal(found.trajectory.camera_to_worlds, known.trajectory.camera_to_worlds)
    # As where a trained run is opened.
    file.unlink()
    assert recording_of(config).event_file.path == file


def test_an_event_file_that_states_its_size_is_enough(tmp_path: Path) -> None:
    (tmp_path / "events.raw").write_bytes(evt3([(3, 4, 100_000, 1), (5, 6, 200_000, -1)]))
    assert recognize(tmp_path) == "event-recording-data"
    capture, frames = OwnRecordingDataParserConfig(data=tmp_path).setup().read_frames()
    assert not frames
    assert capture.intrinsics_origin == "guessed"
    assert (capture.event_camera.width, capture.event_camera.height) == (WIDTH, HEIGHT)
    with pytest.raises(DataError, match="it has no camera cam1; give Kalibr's camchain"):
        OwnRecordingDataParserConfig(data=tmp_path, frame_camera="cam1").setup().read_frames()


def test_camchain_places_both_cameras(truth: Truth) -> None:
    (truth.data / "calibration.json").unlink()
    (truth.data / "camchain.yaml").write_text(yaml.dump(CAMCHAIN))
    with pytest.raises(DataError, match="its cameras are cam0, cam1; name that of the events as --event-camera"):
        opened(truth)
    # They are not taken for images of the event camera.
    with pytest.raises(DataError, match="its cameras are cam0, cam1; name that of the images as --frame-camera"):
        opened(truth, event_camera="cam1")
    options = {"event_camera": "cam1", "frame_camera": "cam0", "image_encoding": "srgb"}
    recording = opened(truth, **options)
    assert recording.image_encoding == "srgb"
    assert recording.event_camera == CameraIntrinsics(60, 40, 50.0, 51.0, 30.0, 20.5, distortion=(-0.1, 0, 0, 0.01, 0))
    assert recording.frame_camera == CameraIntrinsics(
        80, 60, 70.0, 71.0, 40.5, 30.5, "fisheye", (0.01, 0.02, 0.03, 0.04)
    )
    # T_cn_cnm1 takes points from cam0, the frames, to cam1, the events.
    view = recording.reference_views["train"][1]
    np.testing.assert_allclose(view.camera_to_world.numpy(), truth.poses[5] @ make_poses(3)[2], rtol=0, atol=1e-9)
    # And the other way round.
    recording = opened(truth, event_camera="cam0", frame_camera="cam1")
    expected = truth.poses[5] @ np.linalg.inv(make_poses(3)[2])
    view = recording.reference_views["train"][1]
    np.testing.assert_allclose(view.camera_to_world.numpy(), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("place", ["colmap", "colmap/sparse/0"])
def test_colmap_model_gives_poses_of_its_images(place: str, truth: Truth, capsys: pytest.CaptureFixture[str]) -> None:
    (truth.data / "trajectory.txt").unlink()
    shift = make_poses(3)[1]
    calibration = json.loads(json.dumps(CALIBRATION))
    calibration["event_camera"]["T_frame_event"] = shift.tolist()
    (truth.data / "calibration.json").write_text(json.dumps(calibration))
    # Images 2, 0 and 1 in this order; of image 3 COLMAP made nothing.
    write_colmap(truth.data / place, truth.poses[[10, 0, 5]], ["00002.png", "00000.png", "00001.png"])
    assert recognize(truth.data) == "event-recording-data"
    recording = opened(truth)
    assert (recording.trajectory.times - EPOCH * 1_000).tolist() == [0, 5 * 10**8, 10**9]
    assert_same_poses(recording.trajectory.camera_to_worlds, truth.poses[[0, 5, 10]] @ shift, 1e-7)
    assert "COLMAP placed 3 of the 4 images" in capsys.readouterr().out
    named = opened(truth, poses=truth.data / place).trajectory
    assert torch.equal(named.camera_to_worlds, recording.trajectory.camera_to_worlds)
    # The images are where COLMAP put them.
    for view, pose in zip(recording.reference_views["train"], truth.poses[[0, 5, 10]], strict=True):
        np.testing.assert_allclose(view.camera_to_world.numpy(), pose, rtol=0, atol=1e-7)


@pytest.mark.parametrize("pair", [("cam0", "cam1"), ("cam1", "cam0")])
def test_refuse_a_mount_that_the_camchain_lacks(pair: tuple[str, str], truth: Truth) -> None:
    (truth.data / "calibration.json").unlink()
    chain = {name: {k: v for k, v in camera.items() if k != "T_cn_cnm1"} for name, camera in CAMCHAIN.items()}
    (truth.data / "camchain.yaml").write_text(yaml.dump(chain))
    with pytest.raises(DataError, match="cam1 has no T_cn_cnm1"):
        opened(truth, event_camera=pair[0], frame_camera=pair[1])
    # One camera needs no mount.
    opened(truth, event_camera=pair[0], frame_camera=pair[0])


def test_refuse_a_mount_that_the_calibration_lacks(truth: Truth) -> None:
    path = truth.data / "calibration.json"
    calibration = {**CALIBRATION, "w": 80, "h": 60, "fl_x": 70.0, "fl_y": 71.0, "cx": 40.0, "cy": 30.0}
    calibration["event_camera"] = {k: v for k, v in CALIBRATION["event_camera"].items() if k != "T_frame_event"}
    path.write_text(json.dumps(calibration))
    with pytest.raises(DataError, match="T_frame_event is missing; state how the one camera is mounted on the other"):
        opened(truth)
    # A mount of another name is not taken for none, also where both lenses are one.
    for camera in (calibration, {"event_camera": dict(calibration["event_camera"])}):
        path.write_text(json.dumps({**camera, "T_event_frame": np.eye(4).tolist()}))
        with pytest.raises(DataError, match="it states T_event_frame, which is not read; state T_frame_event"):
            opened(truth)
    calibration["event_camera"]["T_frame_event"] = np.eye(4).tolist()
    path.write_text(json.dumps(calibration))
    opened(truth)


def test_refuse_a_colmap_model_that_does_not_fit_the_images(placed: Truth) -> None:
    with pytest.raises(DataError, match="--poses and --colmap are both given; leave out one of them"):
        opened(placed, poses=placed.data / "poses.txt", colmap=placed.data / "colmap")
    listed, model = placed.data / "images.txt", placed.data / "colmap" / "images.txt"
    text = model.read_text()
    model.write_text(text.replace("1 00002.png", "2 00002.png"))
    with pytest.raises(DataError, match="its images are of 2 cameras, and how these are mounted"):
        opened(placed)
    # Scripts drop the empty lines.
    without = text.replace("\n\n", "\n")
    for lines in (without, without.replace(" 1 0", " 1 my image 0")):
        model.write_text(lines)
        with pytest.raises(DataError, match=r"line 6 holds no features .*; write the features of an image, or an"):
            opened(placed)
    model.write_text(text)
    listed.write_text("".join(f"7.5 {line.split()[1]}\n" for line in listed.read_text().splitlines()))
    with pytest.raises(DataError, match=r"images.txt: several images are at 7\.500000000 s; give each image its own"):
        opened(placed)


def test_a_mount_tells_two_cameras_of_one_kind_apart(truth: Truth) -> None:
    camera = CALIBRATION["event_camera"]
    for mount, is_own in ((np.eye(4), True), (make_poses(3)[1], False)):
        calibration = {"event_camera": {**camera, "T_frame_event": mount.tolist()}}
        (truth.data / "calibration.json").write_text(json.dumps(calibration))
        recording = opened(truth)
        assert recording.frame_camera == recording.event_camera
        assert recording.has_own_frames == is_own


def test_frames_of_a_recording_without_poses_are_in_the_order_of_time(truth: Truth) -> None:
    frames = opened(truth).frames
    (truth.data / "trajectory.txt").unlink()
    listed = truth.data / "images.txt"
    lines = listed.read_text().splitlines(keepends=True)
    listed.write_text("".join(lines[::-1]))
    parser = OwnRecordingDataParserConfig(data=truth.data).setup()
    assert parser.read_frames()[1][: len(frames)] == frames
    listed.write_text("".join(f"7.5 {line.split()[1]}\n" for line in lines))
    with pytest.raises(DataError, match=r"several images are at 7\.500000000 s; give each image its own time"):
        parser.read_frames()


def test_refuse_many_images_at_one_time_quickly(tmp_path: Path) -> None:
    many = [(min(time, 99_998), tmp_path) for time in range(100_000)]
    with pytest.raises(DataError, match=r"several images are at 0\.000099998 s"):
        views_on_trajectory(many, make_trajectory())


@pytest.mark.parametrize("is_binary", [False, True])
def test_refuse_a_focal_length_of_colmap_that_is_not_the_calibrated_one(is_binary: bool, placed: Truth) -> None:
    recording = opened(placed)
    focal, width = recording.frame_camera.fx, recording.frame_camera.width
    # Images of half the size: the share of the width counts.
    for factor in (1.05, 1.4):
        values = [factor * focal / 2, factor * focal / 2, width / 4, 10]
        if is_binary:
            # Behind one of a lens that COLMAP has since version 4, and ahead of one that it may get.
            later = struct.pack("<IiQQ16d", 1, 11, width // 2, 20, *values[:2], *[0.0] * 14)
            camera = struct.pack("<IiQQ4d", 1, 1, width // 2, 20, *values)
            camera = struct.pack("<Q", 3) + later + camera + struct.pack("<IiQQ", 3, 99, 8, 9) + bytes(8)
            (placed.data / "colmap" / "cameras.bin").write_bytes(camera)
        else:
            text = f"# one\n1 PINHOLE {width // 2} 20 {' '.join(map(str, values))}\n"
            (placed.data / "colmap" / "cameras.txt").write_text(text)
        if factor == 1.05:
            opened(placed)
    with pytest.raises(DataError, match=r"its focal length is .* px, that of the calibration"):
        opened(placed)


CAMERA_INFO = (
    "image_width: 96\nimage_height: 72\ncamera_name: dvs\n"
    "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [90.0, 0.0, 47.5, 0.0, 91.0, 35.5, 0.0, 0.0, 1.0]\n"
    "distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n"
    "  data: [-0.1, 1e-02, 0.0, 0.0, 0.0]\n"
)


OPENCV = "%YAML:1.0\n---\n" + CAMERA_INFO.replace("_matrix:", "_matrix: !!opencv-matrix").replace(
    "data:", "dt: d\n  data:"
)


@pytest.mark.parametrize(
    "text",
    [
        CAMERA_INFO,
        OPENCV,
        OPENCV.replace("distortion_model: plumb_bob", "fisheye_model: 1").replace(", 0.0, 0.0, 0.0]", ", 0.03, 0.04]"),
        CAMERA_INFO.replace("plumb_bob", "rational_polynomial").replace("0.0]", "0.0, 0.0, 0.0, 0.0]"),
        "header: {seq: 0}\nheight: 72\nwidth: 96\ndistortion_model: plumb_bob\nD: [-0.1, 0.01, 0.0, 0.0, 0.0]\n"
        "K: [90.0, 0.0, 47.5, 0.0, 91.0, 35.5, 0.0, 0.0, 1.0]\n---\n",
    ],
    ids=["file", "file of OpenCV", "fisheye of OpenCV", "rational", "message"],
)
def test_read_the_camera_info_of_ros(text: str, tmp_path: Path) -> None:
    (tmp_path / "camera_info.yaml").write_text(text)
    write_poses(tmp_path / "trajectory.txt")
    np.savez(tmp_path / "events.npz", **random_events())
    recording = recording_of(OwnRecordingDataParserConfig(data=tmp_path))
    lens = ("fisheye", (-0.1, 0.01, 0.03, 0.04)) if "fisheye" in text else ("radial_tangential", (-0.1, 0.01, 0, 0, 0))
    assert recording.event_camera == CameraIntrinsics(96, 72, 90.0, 91.0, 48.0, 36.0, *lens)


MESSAGE = (
    "height: 72\nwidth: 96\nD: []\nK: [90, 0, 47, 0, 90, 35, 0, 0, 1]\nbinning_x: 0\nroi: {x_offset: 0, width: 0}\n"
)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            CAMERA_INFO.replace("plumb_bob", "rational_polynomial").replace("0.0]", "0.0, 0.1, 0.0, 0.0]"),
            r"is 'rational_polynomial', .* calibrate again with plumb_bob or equidistant",
        ),
        (MESSAGE.replace("binning_x: 0", "binning_x: 2"), "the whole sensor, but its pixels are binned or cropped"),
        (MESSAGE.replace("x_offset: 0", "x_offset: 8"), "the whole sensor, but its pixels are binned or cropped"),
    ],
)
def test_refuse_a_lens_of_ros(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "camera_info.yaml").write_text(text)
    with pytest.raises(DataError, match=problem):
        read_calibration(tmp_path / "camera_info.yaml")
