"""``aenerf simulate-video``: the dataset that a video becomes with poses, with COLMAP's, and without any."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.colmap_stand_in import FOUND_BOX, place_frames
from helpers.event_file_checks import read
from helpers.small_datasets import read_native
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.cli import main as program
from aenerf_ns.cli.simulate_video import SimulateVideo
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.dataparsers.own_recording import OwnRecordingDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.tum_trajectory import write_tum_trajectory
from aenerf_ns.pose_estimation.video import open_video
from aenerf_ns.simulator.options import SENSORS
from aenerf_ns.simulator.video_events import video_events, video_simulator

WIDTH, HEIGHT, FRAME = 24, 16, 40_000_000
CAMCHAIN = """
cam0: {camera_model: pinhole, intrinsics: [20.0, 21.0, 11.0, 7.0], distortion_model: radtan,
       distortion_coeffs: [-0.1, 0.02, 0.0, 0.0], resolution: [24, 16]}
cam1: {camera_model: pinhole, intrinsics: [20.0, 21.0, 11.0, 7.0], distortion_model: radtan,
       distortion_coeffs: [-0.1, 0.02, 0.0, 0.0], resolution: [25, 16]}
"""


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """Ten frames of a pattern that moves by a pixel from frame to frame."""
    folder = tmp_path / "frames"
    folder.mkdir()
    pattern = np.kron(np.random.default_rng(0).integers(20, 250, (4, 9)), np.ones((4, 4))).astype(np.uint8)
    lines = []
    for index in range(10):
        Image.fromarray(pattern[:, index : index + WIDTH]).save(folder / f"{index}.png")
        lines.append(f"{0.04 * index:.2f} {index}.png\n")
    (folder / "images.txt").write_text("".join(lines))
    return folder


def make_poses(count: int = 6) -> Trajectory:
    """Poses from 0.04 s on, every 0.05 s."""
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, 0, 3] = 0.1 * torch.arange(count)
    return Trajectory(FRAME + 50_000_000 * np.arange(count), poses)


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    write_tum_trajectory(tmp_path / "poses.txt", make_poses())
    return tmp_path / "poses.txt"


@pytest.fixture
def camchain(tmp_path: Path) -> Path:
    (tmp_path / "camchain.yaml").write_text(CAMCHAIN)
    return tmp_path / "camchain.yaml"


def simulate(output: Path, **options: Any) -> str:
    with CONSOLE.capture() as printed:
        SimulateVideo(output, **options).main()
    return printed.get()


def test_video_with_poses_becomes_a_dataset(
    frames: Path, poses: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "dataset"
    arguments = (
        f"aenerf simulate-video {frames} --output {output} --trajectory {poses} --intrinsics 20 21 11.5 7.5 "
        "--interpolation linear --positive-contrast-threshold 0.3 --contrast-threshold-spread 0.02 "
        "--sensor davis346 --leak-rate 2 --seed 4"
    )
    monkeypatch.setattr(sys, "argv", arguments.split())
    with CONSOLE.capture() as printed:
        program.main()
    assert "up to 40 ms apart, are interpolated. What moves faster" in printed.get()
    assert f"ns-train aenerf --data {output}" in printed.get()
    parser = NativeDataParserConfig(data=output).setup()
    recording = parser.recording
    assert recording.event_camera == recording.frame_camera == CameraIntrinsics(WIDTH, HEIGHT, 20.0, 21.0, 11.5, 7.5)
    assert recording.ground_truth is None
    torch.testing.assert_close(recording.trajectory.camera_to_worlds, make_poses().camera_to_worlds)
    # The events are those of the sensor that the options describe: one option changes one value of --sensor.
    noise = replace(SENSORS["davis346"][1], contrast_threshold_spread=0.02, leak_rate=2.0)
    sensor = SensorModel(0.3, 0.25, SENSORS["davis346"][0].refractory_period)
    simulator = video_simulator(open_video(frames), sensor, noise, seed=4)
    intervals = video_events(open_video(frames), simulator, "linear")
    expected = np.concatenate([interval.events.t for interval in intervals])
    assert len(expected) > 500
    assert recording.sensor == simulator.recorded_sensor()
    assert 20 < recording.sensor.bandwidth < 300
    np.testing.assert_array_equal(read(recording.event_file)[:, 2], expected)
    thresholds = np.load(output / "thresholds_ground_truth.npz")
    np.testing.assert_array_equal(thresholds["positive"], simulator.positive_contrast_threshold)
    np.testing.assert_array_equal(thresholds["negative"], simulator.negative_contrast_threshold)
    # Frames within the poses are reference views at the poses of their times.
    views = recording.reference_views
    assert [len(views[split]) for split in ("train", "val", "test")] == [7, 4, 3]
    for split in ("train", "val", "test"):
        for view in views[split]:
            assert view.time is not None
            np.testing.assert_allclose(view.camera_to_world[:3], make_poses().interpolate(view.time), atol=1e-9)
            original = Image.open(frames / f"{view.time // FRAME}.png").convert("RGB")
            np.testing.assert_array_equal(np.asarray(Image.open(view.file)), np.asarray(original))
        parser.get_dataparser_outputs(split)
    assert not {view.time for view in views["val"]} & {view.time for view in views["test"]}


def test_noise_is_added_to_the_given_poses(frames: Path, poses: Path, camchain: Path, tmp_path: Path) -> None:
    options = {"video": frames, "trajectory": poses, "calibration": camchain, "event_camera": "cam0"}
    simulate(tmp_path / "dataset", **options, pose_noise_degrees=1.0)
    recording = read_native(tmp_path / "dataset")
    # Kalibr counts from the center of the first pixel.
    assert (recording.event_camera.cx, recording.event_camera.distortion[0]) == (11.5, -0.1)
    assert recording.ground_truth is not None
    torch.testing.assert_close(recording.ground_truth.camera_to_worlds, make_poses().camera_to_worlds)
    assert (recording.trajectory.camera_to_worlds - make_poses().camera_to_worlds).abs().max() > 1e-3


def test_colmap_gives_poses_and_lens(frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place_frames(8, monkeypatch)
    printed = simulate(tmp_path / "dataset", video=frames, poses="colmap")
    assert "8 of 10 frames registered" in printed
    assert "The intrinsics were estimated with the poses: focal length 22.0 px" in printed
    assert "the dataset gets a scene box, [[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]]" in printed
    recording = read_native(tmp_path / "dataset")
    assert (recording.event_camera.fx, recording.event_camera.distortion[0]) == (22.0, 0.01)
    assert recording.intrinsics_origin == "estimated"
    assert recording.scene_box is not None
    np.testing.assert_array_equal(recording.scene_box, FOUND_BOX)
    assert recording.trajectory.times.tolist() == [FRAME * index for index in range(8)]
    # The last two frames have no pose, and the first one lies before all events.
    assert [view.time for view in recording.reference_views["train"]] == [FRAME * index for index in range(1, 8)]
    report = json.loads((tmp_path / "dataset" / "poses_report.json").read_text())
    assert report["registered_frames"] == 8
    assert report["intrinsics"]["fl_x"] == 22.0
    printed = simulate(tmp_path / "given", video=frames, poses="colmap", intrinsics=(20.0, 21.0, 11.5, 7.5))
    assert "intrinsics were estimated" not in printed
    recording = read_native(tmp_path / "given")
    assert (recording.event_camera.fy, recording.intrinsics_origin) == (21.0, "given")


def test_video_without_poses_becomes_a_recording(frames: Path, camchain: Path, tmp_path: Path) -> None:
    output = tmp_path / "recording"
    printed = simulate(output, video=frames, calibration=camchain, event_camera="cam0", train_images=1, test_views=3)
    assert "10 images, no poses" in printed
    assert "add trajectory.txt (docs" in printed
    write_tum_trajectory(output / "trajectory.txt", make_poses())
    recording = OwnRecordingDataParserConfig(data=output).setup().recording
    assert recording.event_camera.distortion[:2] == (-0.1, 0.02)
    assert recording.sensor == SensorModel(0.25, 0.25)
    assert recording.image_encoding == "srgb"
    assert [view.time for view in recording.reference_views["train"]] == [FRAME * index for index in range(1, 8)]
    intervals = video_events(open_video(frames), video_simulator(open_video(frames), recording.sensor))
    expected = np.concatenate([interval.events.t for interval in intervals])
    np.testing.assert_array_equal(read(recording.event_file)[:, 2], expected)
    printed = simulate(tmp_path / "no_lens", video=frames, validation_views=0, test_views=0, train_images=4)
    assert "4 images, no poses" in printed
    assert "add calibration.json (with " in printed
    assert "bayer_pattern" not in printed
    written = ["events.h5", "images", "images.txt", "thresholds_ground_truth.npz"]
    assert sorted(path.name for path in (tmp_path / "no_lens").iterdir()) == written


def test_the_filters_of_a_color_sensor_belong_into_its_calibration(frames: Path, tmp_path: Path) -> None:
    printed = simulate(tmp_path / "color", video=frames, bayer_pattern="GRBG")
    assert '"bayer_pattern": "GRBG", ' in printed


LENS = {"intrinsics": (20.0, 21.0, 11.5, 7.5)}


@pytest.mark.parametrize(
    ("files", "options", "message"),
    [
        (("trajectory",), {**LENS, "poses": "colmap"}, "--trajectory with --poses colmap; leave out one"),
        (("calibration",), LENS, "--calibration and --intrinsics are both given; leave out one"),
        (("calibration",), {"event_camera": "cam1"}, "its camera has 25 x 16 pixels, the frames of .* 24 x 16; give"),
        ((), {"intrinsics": (0.0, 21.0, 11.5, 7.5)}, "--intrinsics: fx must be from"),
        ((), {"pose_noise_degrees": 1.0}, "without poses to add it to; give --trajectory"),
        ((), {"pose_noise_degrees": 1.0, "poses": "colmap"}, "with --poses colmap; leave the pose noise out"),
        ((), {"event_camera": "cam1"}, "--event-camera without --calibration; give the camchain"),
        ((), {"positive_contrast_threshold": 9.0, "negative_contrast_threshold": 9.0}, "no pixel changes by a"),
    ],
)
def test_contradicting_options_are_refused(
    files: tuple[str, ...], options: dict[str, Any], message: str, frames: Path, poses: Path, camchain: Path,
    tmp_path: Path,
) -> None:  # fmt: skip
    paths = {"trajectory": poses, "calibration": camchain}
    with pytest.raises(DataError, match=message):
        simulate(tmp_path / "out", video=frames, **{name: paths[name] for name in files}, **options)
    assert not list(tmp_path.glob("*out*"))


def test_a_calibration_without_a_lens_is_refused(frames: Path, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text('{"event_camera": {"width": 24, "height": 16}}')
    with pytest.raises(DataError, match="it states no focal lengths and no principal point; state them, or leave"):
        simulate(tmp_path / "out", video=frames, poses="colmap", calibration=path)


def test_poses_of_another_clock_are_refused(frames: Path, tmp_path: Path) -> None:
    late = make_poses()
    write_tum_trajectory(tmp_path / "late.txt", Trajectory(late.times + 10**9, late.camera_to_worlds))
    with pytest.raises(DataError, match=r"late\.txt: its poses from 1040000000 .* do not overlap"):
        simulate(tmp_path / "out", video=frames, trajectory=tmp_path / "late.txt", **LENS)


def test_too_large_frames_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "large"
    folder.mkdir()
    for index in range(2):
        Image.new("L", (3840, 2160)).save(folder / f"{index}.png", compress_level=1)
    (folder / "images.txt").write_text("0 0.png\n1 1.png\n")
    with pytest.raises(DataError, match=r"an event sensor of 3840 x 2160 pixels is .*; scale the frames down, at"):
        SimulateVideo(tmp_path / "dataset", video=folder).main()
    assert not list(tmp_path.glob("*dataset*"))
