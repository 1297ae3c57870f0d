"""Datasets of other projects, in the layout they are published in: what is read is what was written."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch
import yaml
from conftest import FUZZ_EXAMPLES
from hypothesis import given, settings
from hypothesis import strategies as st
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from aenerf_ns.camera.lens import EventCamera
from aenerf_ns.dataparsers.formats import FORMATS, AutomaticDataParserConfig, recognise
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.dataparsers.own_recording import OwnRecordingDataParserConfig
from aenerf_ns.dataparsers.paev3d import PAEv3DDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.kalibr import read_camchain
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.recording.dataparser import EventDataParserConfig
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.recording import Recording
from aenerf_ns.recording.scene import SCENE
from aenerf_ns.recording.writer import NativeDatasetWriter
from aenerf_ns.training.datamanager import EventDataManagerConfig

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
N_POSES, N_EVENTS = 21, 200
# Microseconds since 1970, where a format has absolute times.
START = 1_600_000_000_000_000
DURATION = 2_000_000


@dataclass(frozen=True)
class Truth:
    """What was written: OpenCV camera-to-world poses (N, 4, 4) with times in ns, events, and the lens in OpenCV's
    terms."""

    data: Path
    times: NDArray[np.int64]
    poses: NDArray[np.float64]
    events: dict[str, NDArray]
    width: int
    height: int
    matrix: NDArray[np.float64]
    distortion: tuple[float, ...]
    fisheye: bool = False


def make_poses(count: int = N_POSES) -> NDArray[np.float64]:
    """A turn about an axis that is no axis of the world, and a motion along another curve."""
    way = np.linspace(0, 1, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    turns = np.array([0.1, 2.0, -0.3]) + np.outer(way, [0.5, -0.7, 0.4])
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    poses[:, :3, 3] = np.stack([0.5 * way, 0.3 * np.sin(3 * way), 0.1 + way**2], 1)
    return poses


def make_events(width: int, height: int, start: int = 0) -> dict[str, NDArray]:
    """Times in microseconds, the first and the last at the ends of the recording."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, DURATION, N_EVENTS))
    t[0], t[-1] = 0, DURATION
    # Few pixels, so that events pair.
    x, y = rng.integers(0, 4, N_EVENTS) + width - 4, rng.integers(0, 3, N_EVENTS) + height - 3
    return {
        "x": x.astype(np.uint16),
        "y": y.astype(np.uint16),
        "t": t + start,
        "p": rng.choice([-1, 1], N_EVENTS).astype(np.int8),
    }


def quaternions(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """x, y, z, w."""
    return Rotation.from_matrix(poses[:, :3, :3]).as_quat()


def write_poses(path: Path, poses: NDArray[np.float64], times: list[str], header: str = "") -> None:
    rows = np.concatenate([poses[:, :3, 3], quaternions(poses)], 1).tolist()
    lines = [f"{time} {' '.join(map(repr, row))}\n" for time, row in zip(times, rows, strict=True)]
    path.write_text(header + "".join(lines))


def write_images(folder: Path, count: int, size: tuple[int, int], name: str = "{:05d}.png") -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / name.format(index) for index in range(count)]
    for index, file in enumerate(files):
        Image.new("L", size, 20 + index).save(file)
    return files


def seconds(nanoseconds: NDArray[np.int64]) -> list[str]:
    return [f"{time // 10**9}.{time % 10**9:09d}" for time in nanoseconds.tolist()]


def write_robust_enerf(
    folder: Path, *, model: str = "plumb_bob", synthetic: bool = False, views: str = "views"
) -> Truth:
    folder.mkdir()
    width, height = 60, 40
    events, poses = make_events(width, height), make_poses()
    times = np.linspace(0, DURATION * 1_000, N_POSES).astype(np.int64)
    matrix = np.array([[50.0, 0, 29.25], [0, 52.0, 20.5], [0, 0, 1]])
    distortion = np.array([-0.05, 0.01, 0.002, -0.001])
    np.savez(
        folder / "raw_events.npz",
        position=np.stack([events["x"], events["y"]], 1),
        timestamp=events["t"] * 1_000,
        polarity=events["p"] > 0,
    )
    np.savez(
        folder / "camera_poses.npz",
        T_wc_position=poses[:, :3, 3],
        T_wc_orientation=quaternions(poses),
        T_wc_timestamp=times,
    )
    np.savez(
        folder / "camera_calibration.npz",
        intrinsics=matrix,
        distortion_params=distortion,
        distortion_model=model,
        img_height=np.uint16(height),
        img_width=np.uint16(width),
        pos_contrast_threshold=np.float32(0.25),
        neg_contrast_threshold=np.float32(0.5),
        refractory_period=np.array(1375.0),
        bayer_pattern="RGGB",
    )
    if synthetic:
        np.savez(folder / "renderer_params.npz", interm_color_space="display", log_eps=0.002)
    for split, angle in (("val", {"camera_angle_x": 0.8}), ("test", {"camera_angle_x": 0.8})):
        place = folder / views
        (place / split).mkdir(parents=True)
        frames = []
        for index in range(2):
            picture = np.full((30, 50, 4), [200, 100, 0, 51], np.uint8)
            Image.fromarray(picture).save(place / split / f"r_{index}.png")
            pose = (poses[index] @ FLIP).tolist()
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose})
        (place / f"transforms_{split}.json").write_text(json.dumps({**angle, "frames": frames}))
    return Truth(folder, times, poses, events, width, height, matrix, tuple(distortion), model == "equidistant")


def write_tum_vie(folder: Path, calibration: Path, sequence: str = "mocap-desk2", side: str = "left") -> Truth:
    folder.mkdir(exist_ok=True)
    for file in calibration.glob("*.json"):
        shutil.copyfile(file, folder / file.name)
    index = {"left": 2, "right": 3}[side]
    which = "A" if sequence == "mocap-desk2" else "B"
    cameras = json.loads((folder / f"camera-calibration{which}.json").read_text())["value0"]
    mocap = json.loads((folder / f"mocap-imu-calibration{which}.json").read_text())["value0"]

    def matrix_of(values: dict[str, float]) -> NDArray[np.float64]:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat([values[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
        pose[:3, 3] = [values[name] for name in ("px", "py", "pz")]
        return pose

    poses = make_poses(241)
    times = START * 1_000 + np.linspace(0, DURATION * 1_000, 241).astype(np.int64)
    # T_world_camera = T_world_marker inv(T_imu_marker) T_imu_camera, solved for the marker.
    imu_camera, imu_marker = matrix_of(cameras["T_imu_cam"][index]), matrix_of(mocap["T_imu_marker"])
    truth = folder / f"{sequence}-vi_gt_data"
    truth.mkdir(exist_ok=True)
    markers = poses @ np.linalg.inv(imu_camera) @ imu_marker
    times -= times % 1_000
    write_poses(truth / "mocap_data.txt", markers, (times // 1_000).astype(str).tolist(), "# timestamp[us] p q\n")
    events = make_events(1280, 720, START)
    with h5py.File(folder / f"{sequence}-events_{side}.h5", "w") as file:
        for name, values in events.items():
            file[f"events/{name}"] = (values > 0).astype(np.uint8) if name == "p" else values
        file["ms_to_idx"] = np.zeros(3, np.uint64)
    write_images(truth / f"{side}_images", 3, (1024, 1024), "{:05d}.jpg")
    stamps = [START + 100_000, START + 333_333, START + 1_900_000]
    (truth / f"{side}_images" / f"image_timestamps_{side}.txt").write_text("\n".join(map(str, stamps)) + "\n")
    lens = cameras["intrinsics"][index]["intrinsics"]
    matrix = np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1]])
    distortion = tuple(lens[name] for name in ("k1", "k2", "k3", "k4"))
    return Truth(folder, times, poses, events, 1280, 720, matrix, distortion, fisheye=True)


EDS_MATRIX = np.array(
    [[560.8520948927032, 0, 313.00733235019237], [0, 560.6295819972383, 217.32858679842997], [0, 0, 1]]
)
EDS_DISTORTION = (-0.09776467241921379, 0.2143738428636279, -0.004710710105172864, -0.004215916089401789)


def write_eds(folder: Path) -> Truth:
    folder.mkdir()
    poses, times = make_poses(), START * 1_000 + np.linspace(0, DURATION * 1_000, N_POSES).astype(np.int64)
    events = make_events(640, 480, START)
    with h5py.File(folder / "events.h5", "w") as file:
        for name, values in events.items():
            file[name] = (values > 0).astype(np.uint8) if name == "p" else values
    write_poses(folder / "stamped_groundtruth.txt", poses, seconds(times), "# t p q\n")
    write_images(folder / "images", 3, (640, 480), "frame_{:010d}.png")
    stamps = [START + 50_000, START + 800_000, START + 1_700_000]
    (folder / "images_timestamps.txt").write_text("\n".join(map(str, stamps)) + "\n")
    return Truth(folder, times, poses, events, 640, 480, EDS_MATRIX, EDS_DISTORTION)


def write_enerf_esim(folder: Path) -> Truth:
    (folder / "events").mkdir(parents=True)
    width, height, focal = 64, 48, 70.0
    poses, times = make_poses(), np.linspace(0, DURATION * 1_000, N_POSES).astype(np.int64)
    events = make_events(width, height)
    table = np.stack([events["x"], events["y"], events["t"] * 1_000, events["p"]], 1).astype(np.float64)
    # The second number has more digits, and a file may be empty.
    for number, rows in (("2", table[:90]), ("9", table[:0]), ("10", table[90:])):
        np.save(folder / "events" / f"{number}.npy", rows)
    write_poses(folder / "scene_poses_all.txt", poses, times.astype(str).tolist(), "# stamps in ns\n")
    bounds = np.zeros((12, 17))
    bounds[:, [4, 9, 14]] = height, width, focal
    np.save(folder / "poses_bounds.npy", bounds)
    write_images(folder / "images", 3, (width, height))
    (folder / "images" / "image_stamps_ns.txt").write_text("100\n1000000000\n1900000000\n")
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Truth(folder, times, poses, events, width, height, matrix, ())


def write_matrices(folder: Path, matrices: NDArray[np.float64]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for index, matrix in enumerate(matrices):
        (folder / f"r_{index:05d}.txt").write_text(" ".join(map(repr, matrix.ravel().tolist())))


def write_eventnerf(folder: Path) -> Truth:
    poses, events = make_poses(), make_events(346, 260)
    # The edge of the image is at 0, and the last event at its own time, not after the first.
    intrinsics = np.array([[400.0, 0, 170, 0], [0, 410.0, 128.5, 0], [0, 0, 1, 0], [0, 0, 0, 1], [-0.1, 0.02, 0, 0]])
    for split, count in (("train", N_POSES), ("validation", 3), ("test", 2)):
        write_matrices(folder / split / "pose", poses[:count])
        write_matrices(folder / split / "intrinsics", np.tile(intrinsics, (count, 1, 1)))
        write_images(folder / split / "rgb", count, (346, 260))
    (folder / "train" / "events").mkdir()
    np.savez(folder / "train" / "events" / "test_lego.npz", **events)
    times = np.array([2_000_000_000 * i // 20 for i in range(N_POSES)])
    # Written with the centre of the first pixel at 0, as OpenCV has it.
    matrix = np.array([[400.0, 0, 169.5], [0, 410.0, 128.0], [0, 0, 1]])
    return Truth(folder, times, poses, events, 346, 260, matrix, (-0.1, 0.02, 0.0, 0.0))


def write_paev3d(folder: Path) -> Truth:
    poses, events = make_poses(), make_events(640, 480, start=777)
    (folder / "H5_Files" / "Bunny").mkdir(parents=True)
    (folder / "Render_info" / "Bunny").mkdir(parents=True)
    with h5py.File(folder / "H5_Files" / "Bunny" / "event.h5", "w") as file:
        file["events"] = np.stack([events["t"], events["x"], events["y"], events["p"] > 0], 1).astype(np.float64)
    for index, pose in enumerate(poses):
        objects = [{"name": "Bunny", "pose": np.eye(4)}, {"name": "Camera", "pose": pose @ FLIP}]
        np.savez(folder / "Render_info" / "Bunny" / f"{index:04d}.npz", object_poses=objects, depth_map=np.zeros(3))
    write_images(folder / "Render_info" / "Bunny", N_POSES, (640, 480))
    write_matrices(
        folder / "Intrinsics", np.array([[[500.0, 0, 320, 0], [0, 500, 240, 0], [0, 0, 1, 0], [0, 0, 0, 1]]])
    )
    times = np.array([777_000 + 2_000_000_000 * i // 20 for i in range(N_POSES)])
    matrix = np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]])
    return Truth(folder, times, poses, events, 640, 480, matrix, ())


CALIBRATION = {
    "image_encoding": "linear",
    "event_camera": {
        "width": 60, "height": 40, "fl_x": 50.0, "fl_y": 51.0, "cx": 30.0, "cy": 20.5, "k1": -0.1, "p2": 0.01,
        "positive_contrast_threshold": 0.3, "negative_contrast_threshold": 0.2, "refractory_period_ns": 100,
    },
}  # fmt: skip


def write_own(folder: Path) -> Truth:
    folder.mkdir()
    poses, times = make_poses(), START * 1_000 + np.linspace(0, DURATION * 1_000, N_POSES).astype(np.int64)
    events = make_events(60, 40, START)
    with h5py.File(folder / "events.h5", "w") as file:
        for name, values in events.items():
            file[f"events/{name}"] = {"t": values - START, "p": values > 0}.get(name, values)
        file["t_offset"] = START
    write_poses(folder / "trajectory.txt", poses, seconds(times))
    (folder / "calibration.json").write_text(json.dumps(CALIBRATION))
    write_images(folder / "images", 4, (60, 40))
    stamps = seconds(START * 1_000 + np.array([0, 5 * 10**8, 10**9, 9 * 10**9]))
    lines = [f"{stamp} images/{index:05d}.png\n" for index, stamp in enumerate(stamps)]
    (folder / "images.txt").write_text("".join(lines))
    matrix = np.array([[50.0, 0, 29.5], [0, 51.0, 20.0], [0, 0, 1]])
    return Truth(folder, times, poses, events, 60, 40, matrix, (-0.1, 0.0, 0.0, 0.01))


WRITERS: dict[str, Callable[[Path], Truth]] = {
    "robust-enerf-data": write_robust_enerf,
    "eds-data": write_eds,
    "enerf-esim-data": write_enerf_esim,
    "eventnerf-data": write_eventnerf,
    "paev3d-data": write_paev3d,
    "event-recording-data": write_own,
}
AS_RECORDED = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}


@pytest.fixture(params=[*WRITERS, "tum-vie-data"])
def written(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Truth]:
    """A dataset of every format, under its name."""
    if request.param == "tum-vie-data":
        return request.param, write_tum_vie(tmp_path / "made", request.getfixturevalue("tum_vie_calibration"))
    return request.param, WRITERS[request.param](tmp_path / "made")


def config_of(name: str, data: Path, **options: object) -> EventDataParserConfig:
    return replace(FORMATS[name], data=data, **options)


def recording_of(config: EventDataParserConfig) -> Recording:
    return config.setup().read_recording()


def outputs_of(config: DataParserConfig, split: str = "train") -> DataparserOutputs:
    return config.setup().get_dataparser_outputs(split)


def assert_same_poses(actual: torch.Tensor, expected: NDArray[np.float64], tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(actual[:, :3].numpy(), expected[:, :3], rtol=0, atol=tolerance)


def test_poses_and_events_are_those_written(written: tuple[str, Truth]) -> None:
    name, truth = written
    recording = recording_of(config_of(name, truth.data))
    np.testing.assert_array_equal(recording.trajectory.times.numpy(), truth.times)
    assert_same_poses(recording.trajectory.camera_to_worlds, truth.poses)
    chunks = list(recording.event_file.chunks())
    for column, values in truth.events.items():
        values = values * 1_000 if column == "t" else values
        np.testing.assert_array_equal(np.concatenate([getattr(chunk, column) for chunk in chunks]), values)
    assert recording.event_file.time_span() == (truth.events["t"][0] * 1_000, truth.events["t"][-1] * 1_000)


def test_rays_are_those_of_opencv(written: tuple[str, Truth]) -> None:
    name, truth = written
    camera = recording_of(config_of(name, truth.data)).event_camera
    assert (camera.width, camera.height) == (truth.width, truth.height)
    project = cv2.fisheye.projectPoints if truth.fisheye else cv2.projectPoints
    lens = np.array(truth.distortion or (0.0,) * 4)
    for u, v in ((0, 0), (truth.width // 2, truth.height // 2), (truth.width - 9, truth.height // 3)):
        # A window of the sensor: all of it takes seconds.
        window = replace(camera, width=9, height=7, cx=camera.cx - u, cy=camera.cy - v)
        directions, valid = window.pixel_directions()
        assert valid.all()
        points = (directions * [1, -1, -1]).reshape(-1, 1, 3)
        pixels = project(points, np.zeros(3), np.zeros(3), truth.matrix, lens)[0].reshape(7, 9, 2)
        np.testing.assert_allclose(pixels[..., 0], np.arange(u, u + 9)[None].repeat(7, 0), rtol=0, atol=1e-6)
        np.testing.assert_allclose(pixels[..., 1], np.arange(v, v + 7)[:, None].repeat(9, 1), rtol=0, atol=1e-6)


def test_every_format_is_recognised(written: tuple[str, Truth]) -> None:
    name, truth = written
    assert recognise(truth.data) == name
    parser = AutomaticDataParserConfig(data=truth.data).setup()
    assert type(parser.config) is type(FORMATS[name])
    pairs = EventDataset(parser.get_dataparser_outputs("train")).pairs
    assert pairs.num_events == N_EVENTS
    assert len(pairs) > 100
    # What is shared among runs stays as it was.
    assert FORMATS[name].start_time_ns is None
    assert FORMATS[name].data == type(FORMATS[name])().data


def test_native_datasets_and_ecd_are_recognised(tmp_path: Path, slider_depth: Path) -> None:
    write_native(
        recording_of(config_of("robust-enerf-data", write_robust_enerf(tmp_path / "made").data)), tmp_path / "n"
    )
    assert recognise(tmp_path / "n") == "aenerf-data"
    assert recognise(slider_depth) == "ecd-data"


def write_native(recording: Recording, folder: Path) -> Path:
    """Converts a recording, without its images."""
    box = None if recording.scene_box is None else recording.scene_box.numpy()
    with NativeDatasetWriter(
        folder, recording.event_camera, recording.sensor, recording.image_encoding, box, recording.max_pose_gap
    ) as writer:
        writer.add_trajectories(recording.trajectory)
        for chunk in recording.event_file.chunks():
            writer.events.append(chunk)
    return folder


def test_converted_to_the_native_format_nothing_changes(written: tuple[str, Truth], tmp_path: Path) -> None:
    name, truth = written
    config = config_of(name, truth.data, **AS_RECORDED)
    folder = write_native(recording_of(config), tmp_path / "native")
    before, after = outputs_of(config).metadata, outputs_of(NativeDataParserConfig(data=folder, **AS_RECORDED)).metadata
    # Equal lenses have equal rays.
    for key in ("event_camera", "sensor", "window", "image_encoding", "bounded"):
        assert getattr(before[SCENE], key) == getattr(after[SCENE], key), key
    assert torch.equal(before[SCENE].trajectory.times, after[SCENE].trajectory.times)
    assert_same_poses(after[SCENE].trajectory.camera_to_worlds, before[SCENE].trajectory.camera_to_worlds.numpy())
    before_events, after_events = (list(metadata[SCENE].event_file.chunks()) for metadata in (before, after))
    for column in "xytp":
        np.testing.assert_array_equal(
            *(np.concatenate([getattr(chunk, column) for chunk in events]) for events in (before_events, after_events))
        )


EVENTS = {
    "robust-enerf-data": "raw_events.npz",
    "tum-vie-data": "mocap-desk2-events_left.h5",
    "eds-data": "events.h5",
    "enerf-esim-data": "events",
    "eventnerf-data": "train/events",
    "paev3d-data": "H5_Files/Bunny/event.h5",
    "event-recording-data": "events.h5",
}


def test_a_run_opens_without_events_and_in_another_folder(
    written: tuple[str, Truth], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, truth = written
    monkeypatch.chdir(tmp_path)
    config = EventDataManagerConfig(dataparser=AutomaticDataParserConfig(data=Path(truth.data.name)))
    manager = config.setup(device="cpu", test_mode="inference", world_size=1, local_rank=0)
    assert type(config.dataparser) is type(FORMATS[name])
    saved = yaml.dump(config)
    events = truth.data / EVENTS[name]
    shutil.rmtree(events) if events.is_dir() else events.unlink()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    again = yaml.load(saved, Loader=yaml.Loader).setup(device="cpu", test_mode="inference", world_size=1, local_rank=0)
    assert torch.equal(manager.train_dataset.cameras.camera_to_worlds, again.train_dataset.cameras.camera_to_worlds)
    assert manager.train_dataset.metadata[SCENE].window == again.train_dataset.metadata[SCENE].window
    assert again.train_dataset.get_numpy_image(0).std() == 0
    for before, after in zip(manager.eval_dataset.image_filenames, again.eval_dataset.image_filenames, strict=True):
        assert before == after


def test_a_folder_of_no_known_format_says_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"no known format of recordings; looked for .*raw_events.npz.*H5_Files"
    ) as error:
        recognise(tmp_path)
    assert "\n" not in str(error.value)
    for name in FORMATS:
        assert name in str(error.value)
    with pytest.raises(DataError, match="nowhere: there is no such folder"):
        recognise(tmp_path / "nowhere")
    with pytest.raises(SystemExit, match=r"^Error: .*no known format"):
        EventDataManagerConfig(dataparser=AutomaticDataParserConfig(data=tmp_path)).setup(device="cpu")


def test_estimated_poses_may_take_the_place_of_the_datasets(written: tuple[str, Truth], tmp_path: Path) -> None:
    name, truth = written
    other = truth.poses.copy()
    other[:, :3, 3] += 0.01
    write_poses(tmp_path / "other.txt", other, seconds(truth.times))
    recording = recording_of(config_of(name, truth.data, trajectory=tmp_path / "other.txt"))
    assert recording.ground_truth is not None
    assert_same_poses(recording.ground_truth.camera_to_worlds, truth.poses)
    assert_same_poses(recording.trajectory.camera_to_worlds, other)


def interpolated(truth: Truth, time: int) -> NDArray[np.float64]:
    """The pose (4, 4) at a time in ns: linear in the position, the shortest turn."""
    after = int(np.searchsorted(truth.times, time))
    after = max(after, 1)
    first, last = truth.poses[after - 1], truth.poses[after]
    weight = (time - truth.times[after - 1]) / (truth.times[after] - truth.times[after - 1])
    step = Rotation.from_matrix(first[:3, :3].T @ last[:3, :3]).as_rotvec()
    pose = np.eye(4)
    pose[:3, :3] = first[:3, :3] @ Rotation.from_rotvec(weight * step).as_matrix()
    pose[:3, 3] = (1 - weight) * first[:3, 3] + weight * last[:3, 3]
    return pose


# --- Robust e-NeRF


def test_robust_enerf_states_its_sensor_and_views(tmp_path: Path) -> None:
    truth = write_robust_enerf(tmp_path / "made", model="equidistant")
    recording = recording_of(config_of("robust-enerf-data", truth.data))
    assert recording.sensor == SensorModel(0.25, 0.5, 1375, "RGGB")
    assert recording.event_camera.lens_model == "fisheye"
    assert recording.event_camera.distortion == truth.distortion
    assert recording.scene_box is None
    focal = 25 / np.tan(0.4)
    assert recording.frame_camera == EventCamera(50, 30, focal, focal, 25.0, 15.0)
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
    assert recording.frame_camera == EventCamera(50, 30, 40.0, 41.0, 25.0, 14.5)
    assert len(recording.reference_views["val"]) == 2


def test_synthetic_scenes_of_robust_enerf_have_a_box_and_a_white_background(tmp_path: Path) -> None:
    truth = write_robust_enerf(tmp_path / "made", synthetic=True)
    config = config_of("robust-enerf-data", truth.data)
    box = recording_of(config).scene_box
    assert box is not None
    assert box.tolist() == [[-1.5] * 3, [1.5] * 3]
    image = EventDataset(outputs_of(config, "test")).get_image_float32(0)
    # Alpha 0.2 over white.
    torch.testing.assert_close(image[0, 0], 0.2 * torch.tensor([200, 100, 0]) / 255 + 0.8, rtol=0, atol=1e-6)
    assert recording_of(replace(config, scene_half_extent=0.0)).scene_box is None


# --- TUM-VIE


def test_tum_vie_has_two_calibrations_and_two_sides(tmp_path: Path, tum_vie_calibration: Path) -> None:
    for sequence, side in (("mocap-desk2", "right"), ("office-maze", "left"), ("office-maze", "right")):
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

    def imu_from(index: int) -> NDArray[np.float64]:
        values, pose = cameras["T_imu_cam"][index], np.eye(4)
        pose[:3, :3] = Rotation.from_quat([values[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
        pose[:3, 3] = [values[name] for name in ("px", "py", "pz")]
        return pose

    for view, time in zip(recording.reference_views["train"], (100_000, 333_333, 1_900_000), strict=True):
        assert view.time == (START + time) * 1_000
        expected = interpolated(truth, view.time) @ np.linalg.inv(imu_from(2)) @ imu_from(0)
        np.testing.assert_allclose(view.camera_to_world.numpy(), expected, rtol=0, atol=1e-9)
    assert recording.frame_camera.width == recording.frame_camera.height == 1024
    assert recording.frame_camera.cx == cameras["intrinsics"][0]["intrinsics"]["cx"] + 0.5
    assert [len(recording.reference_views[split]) for split in ("train", "val", "test")] == [3, 2, 1]


def test_events_in_a_gap_of_the_poses_are_left_out_also_after_conversion(
    tmp_path: Path, tum_vie_calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = write_tum_vie(tmp_path / "made", tum_vie_calibration)
    path = truth.data / "mocap-desk2-vi_gt_data" / "mocap_data.txt"
    header, *rows = path.read_text().splitlines(keepends=True)
    # Poses are 8.3 ms apart: one lost is no gap, a second is.
    path.write_text("".join([header, *rows[:30], *rows[31:61], *rows[181:]]))
    config = config_of("tum-vie-data", truth.data)
    gap = (int(truth.times[60]), int(truth.times[181]))
    folder = write_native(recording_of(config), tmp_path / "native")
    capsys.readouterr()
    for parser in (config, NativeDataParserConfig(data=folder)):
        outputs = outputs_of(parser)
        assert (
            " ".join(capsys.readouterr().out.split()).count("The poses have 1 gap(s) of more than 0.05 s, 1.0 s in")
            == 1
        )
        assert outputs.metadata[SCENE].window.gaps == (gap,)
        pairs = EventDataset(outputs).pairs
        times = truth.events["t"] * 1_000
        assert pairs.num_outside == int(((times > gap[0]) & (times < gap[1])).sum()) > 50
        assert not ((pairs.time > gap[0]) & (pairs.previous_time < gap[1])).any()
        assert (pairs.time <= gap[0]).any()
        assert (pairs.previous_time >= gap[1]).any()
    # An image in the gap has no pose: here none of the three, so one is moved there.
    stamps = truth.data / "mocap-desk2-vi_gt_data" / "left_images" / "image_timestamps_left.txt"
    stamps.write_text(f"{START + 100_000}\n{START + 900_000}\n{START + 1_900_000}\n")
    views = recording_of(config).reference_views["train"]
    assert [view.file.name for view in views] == ["00000.jpg", "00002.jpg"]
    # Another limit may be given.
    assert outputs_of(replace(config, max_pose_gap_ns=2 * 10**9)).metadata[SCENE].window.gaps == ()


def test_several_sequences_in_a_folder_are_told_apart(tmp_path: Path, tum_vie_calibration: Path) -> None:
    for sequence in ("mocap-desk2", "office-maze"):
        write_tum_vie(tmp_path / "made", tum_vie_calibration, sequence)
    with pytest.raises(
        DataError, match=r"it holds 2 sequences; give the event file of one .*/mocap-desk2-events_left.h5"
    ):
        recording_of(config_of("tum-vie-data", tmp_path / "made"))
    one = tmp_path / "made" / "office-maze-events_left.h5"
    assert recognise(one) == "tum-vie-data"
    assert recording_of(config_of("tum-vie-data", one)).event_file.path == one


# --- EDS


def test_eds_views_are_those_of_the_frame_camera(tmp_path: Path) -> None:
    truth = write_eds(tmp_path / "made")
    chain = {
        "cam0": {
            "intrinsics": [766.0, 767.0, 291.0, 227.0],
            "resolution": [640, 480],
            "distortion_coeffs": [0.1, 0, 0, 0],
        },
        "cam1": {
            "camera_model": "pinhole",
            "distortion_model": "radtan",
            "intrinsics": [560.0, 561.0, 313.0, 217.0],
            "resolution": [640, 480],
            "distortion_coeffs": [-0.1, 0.2, 0.003, 0.004],
            "T_cn_cnm1": make_poses(3)[1].tolist(),
        },
    }
    (tmp_path / "chain.yaml").write_text(yaml.dump(chain))
    given = recording_of(config_of("eds-data", truth.data, calibration=tmp_path / "chain.yaml"))
    assert given.event_camera == EventCamera(
        640, 480, 560.0, 561.0, 313.5, 217.5, distortion=(-0.1, 0.2, 0.003, 0.004, 0.0)
    )
    assert given.frame_camera.cx == 291.5
    view = given.reference_views["train"][1]
    assert view.time == (START + 800_000) * 1_000
    # Kalibr's matrix takes points from the frame camera to the event camera.
    expected = interpolated(truth, view.time) @ make_poses(3)[1]
    np.testing.assert_allclose(view.camera_to_world.numpy(), expected, rtol=0, atol=1e-9)


# --- Poses without times


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
    assert recognise(truth.data / "train") == "eventnerf-data"
    (truth.data / "train").rename(truth.data / "train1")
    shutil.copytree(truth.data / "train1", truth.data / "train2")
    with pytest.raises(DataError, match=r"2 training splits; give one as --data, such as .*train1"):
        recording_of(config_of("eventnerf-data", truth.data))
    split = recording_of(config_of("eventnerf-data", truth.data / "train2"))
    assert len(split.reference_views["val"]) == 3
    # Without others the images of the training split serve.
    for name in ("validation", "test"):
        shutil.rmtree(truth.data / name)
    split = recording_of(config_of("eventnerf-data", truth.data / "train2"))
    assert (len(split.reference_views["val"]), len(split.reference_views["test"])) == (11, 10)


def test_a_unit_of_time_may_be_given_for_poses_without_times(tmp_path: Path) -> None:
    truth = write_eventnerf(tmp_path / "made")
    recording = recording_of(config_of("eventnerf-data", truth.data, time_unit="ns"))
    assert recording.trajectory.end == recording.event_file.time_span()[1] == DURATION
    recording = recording_of(config_of("eventnerf-data", truth.data, first_pose_time_ns=5, last_pose_time_ns=105))
    assert recording.trajectory.times.tolist() == list(range(5, 106, 5))


def test_poses_of_paev3d_run_no_code(tmp_path: Path) -> None:
    truth = write_paev3d(tmp_path / "made")
    file = truth.data / "Render_info" / "Bunny" / "0003.npz"

    class Harm:
        def __reduce__(self) -> tuple:
            return os.mkdir, (str(tmp_path / "harm"),)

    np.savez(file, object_poses=np.array([Harm()], dtype=object))
    with pytest.raises(DataError, match=r"0003.npz: its object_poses cannot be read .it asks for posix.mkdir"):
        recording_of(PAEv3DDataParserConfig(data=truth.data))
    assert not (tmp_path / "harm").exists()


def test_scenes_of_paev3d_are_told_apart(tmp_path: Path) -> None:
    truth = write_paev3d(tmp_path / "made")
    for part in ("H5_Files", "Render_info"):
        shutil.copytree(truth.data / part / "Bunny", truth.data / part / "Car")
    with pytest.raises(DataError, match=r"it holds 2 scenes; give one as --data, such as .*H5_Files/Bunny"):
        recording_of(PAEv3DDataParserConfig(data=truth.data))
    one = truth.data / "H5_Files" / "Car"
    assert recognise(one) == "paev3d-data"
    assert recording_of(PAEv3DDataParserConfig(data=one)).event_file.path.parent == one


# --- Own recordings


def test_own_recordings_have_views_at_their_times(tmp_path: Path) -> None:
    truth = write_own(tmp_path / "made")
    recording = recording_of(OwnRecordingDataParserConfig(data=truth.data))
    assert recording.sensor == SensorModel(0.3, 0.2, 100)
    assert recording.image_encoding == "linear"
    # The fourth image is after the last pose.
    assert [view.time - START * 1_000 for view in recording.reference_views["train"]] == [0, 5 * 10**8, 10**9]
    view = recording.reference_views["test"][0]
    np.testing.assert_allclose(view.camera_to_world.numpy(), truth.poses[5], rtol=0, atol=1e-9)


def test_own_recordings_may_be_put_together_from_anywhere(tmp_path: Path) -> None:
    truth = write_own(tmp_path / "made")
    (tmp_path / "parts").mkdir()
    renamed = {"events": "record.hdf5", "calibration": "cameras.json", "poses": "mocap.txt", "images": "stamps.txt"}
    for name, new in (
        ("events.h5", "record.hdf5"),
        ("calibration.json", "cameras.json"),
        ("trajectory.txt", "mocap.txt"),
    ):
        (truth.data / name).rename(tmp_path / "parts" / new)
    shutil.move(truth.data / "images", tmp_path / "parts" / "images")
    (truth.data / "images.txt").rename(tmp_path / "parts" / "stamps.txt")
    options = {name: tmp_path / "parts" / new for name, new in renamed.items()}
    recording = recording_of(OwnRecordingDataParserConfig(data=tmp_path / "parts", **options))
    assert_same_poses(recording.trajectory.camera_to_worlds, truth.poses)
    assert len(recording.reference_views["train"]) == 3
    assert recording.event_file.time_span()[0] == START * 1_000


CAMCHAIN = {
    "cam0": {
        "camera_model": "pinhole",
        "distortion_model": "equidistant",
        "intrinsics": [70.0, 71.0, 40.0, 30.0],
        "resolution": [80, 60],
        "distortion_coeffs": [0.01, 0.02, 0.03, 0.04],
        "rostopic": "/frames",
    },
    "cam1": {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "intrinsics": [50.0, 51.0, 29.5, 20.0],
        "resolution": [60, 40],
        "distortion_coeffs": [-0.1, 0.0, 0.0, 0.01],
        "T_cn_cnm1": make_poses(3)[2].tolist(),
    },
}


def test_kalibrs_camchain_places_both_cameras(tmp_path: Path) -> None:
    truth = write_own(tmp_path / "made")
    (truth.data / "calibration.json").unlink()
    (truth.data / "camchain.yaml").write_text(yaml.dump(CAMCHAIN))
    with pytest.raises(DataError, match="its cameras are cam0, cam1; name that of the events as --event-camera"):
        recording_of(OwnRecordingDataParserConfig(data=truth.data))
    recording = recording_of(OwnRecordingDataParserConfig(data=truth.data, event_camera="cam1", frame_camera="cam0"))
    assert recording.event_camera == EventCamera(60, 40, 50.0, 51.0, 30.0, 20.5, distortion=(-0.1, 0, 0, 0.01, 0))
    assert recording.frame_camera == EventCamera(80, 60, 70.0, 71.0, 40.5, 30.5, "fisheye", (0.01, 0.02, 0.03, 0.04))
    # T_cn_cnm1 takes points from cam0, the frames, to cam1, the events.
    view = recording.reference_views["train"][1]
    np.testing.assert_allclose(view.camera_to_world.numpy(), truth.poses[5] @ make_poses(3)[2], rtol=0, atol=1e-9)
    # And the other way round.
    recording = recording_of(OwnRecordingDataParserConfig(data=truth.data, event_camera="cam0", frame_camera="cam1"))
    expected = truth.poses[5] @ np.linalg.inv(make_poses(3)[2])
    np.testing.assert_allclose(
        recording.reference_views["train"][1].camera_to_world.numpy(), expected, rtol=0, atol=1e-9
    )


def write_colmap(folder: Path, poses: NDArray[np.float64], names: list[str]) -> None:
    """COLMAP's text model: world-to-camera, qw first."""
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 60 40 50 51 30 20.5\n")
    lines = []
    for index, (pose, name) in enumerate(zip(poses, names, strict=True), start=1):
        inverse = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat().tolist()
        values = [w, x, y, z, *inverse[:3, 3].tolist()]
        lines.append(f"{index} {' '.join(map(repr, values))} 1 {name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")


@pytest.mark.parametrize("place", ["colmap", "colmap/sparse/0"])
def test_a_colmap_model_gives_poses_at_the_times_of_its_images(
    place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = write_own(tmp_path / "made")
    (truth.data / "trajectory.txt").unlink()
    shift = make_poses(3)[1]
    calibration = json.loads(json.dumps(CALIBRATION))
    calibration["event_camera"]["T_frame_event"] = shift.tolist()
    (truth.data / "calibration.json").write_text(json.dumps(calibration))
    # Images 2, 0 and 1 in this order; of image 3 COLMAP made nothing.
    write_colmap(truth.data / place, truth.poses[[10, 0, 5]], ["00002.png", "00000.png", "00001.png"])
    assert recognise(truth.data) == "event-recording-data"
    recording = recording_of(OwnRecordingDataParserConfig(data=truth.data))
    assert (recording.trajectory.times - START * 1_000).tolist() == [0, 5 * 10**8, 10**9]
    assert_same_poses(recording.trajectory.camera_to_worlds, truth.poses[[0, 5, 10]] @ shift, 1e-7)
    assert "COLMAP placed 3 of the 4 images" in capsys.readouterr().out
    # The images are where COLMAP put them.
    for view, pose in zip(recording.reference_views["train"], truth.poses[[0, 5, 10]], strict=True):
        np.testing.assert_allclose(view.camera_to_world.numpy(), pose, rtol=0, atol=1e-7)


# --- What is malformed


def edit_npz(name: str, **arrays: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        with np.load(folder / name) as file:
            content = {key: file[key] for key in file.files}
        content.update(arrays)
        np.savez(folder / name, **{key: value for key, value in content.items() if value is not None})

    return change


def edit_json(name: str, edit: Callable[[dict], object]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        meta = json.loads((folder / name).read_text())
        edit(meta)
        (folder / name).write_text(json.dumps(meta))

    return change


def text(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(content)


def remove(pattern: str) -> Callable[[Path], object]:
    return lambda folder: [shutil.rmtree(p) if p.is_dir() else p.unlink() for p in sorted(folder.glob(pattern))]


def replace_line(name: str, index: int, line: str) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        lines[index] = line
        (folder / name).write_text("\n".join(lines) + "\n")

    return change


SCALED = np.diag([2.0, 2, 2, 1]).tolist()
CALIB, POSES, VIEWS = "camera_calibration.npz", "camera_poses.npz", "views/transforms_val.json"
CAMERAS, MOCAP = "camera-calibrationA.json", "mocap-imu-calibrationA.json"
TRUTH = "mocap-desk2-vi_gt_data"
FAULTS: dict[str, dict[str, tuple[Callable[[Path], object], str]]] = {
    "robust-enerf-data": {
        "no calibration": (remove(CALIB), f"{CALIB}: there is no such file"),
        "no poses": (remove(POSES), f"{POSES}: there is no such file"),
        "no events": (remove("raw_events.npz"), "raw_events.npz: there is no such event file"),
        "no intrinsics": (edit_npz(CALIB, intrinsics=None), f"{CALIB}: it has no array intrinsics"),
        "flat intrinsics": (edit_npz(CALIB, intrinsics=np.ones(9)), r"intrinsics has type float64 and shape \(9,\)"),
        "words as intrinsics": (edit_npz(CALIB, intrinsics=np.full((3, 3), "f")), "intrinsics has type <U1"),
        "unknown distortion": (edit_npz(CALIB, distortion_model="fov"), "distortion_model is 'fov'; use one of plumb"),
        "three distortions": (edit_npz(CALIB, distortion_params=np.zeros(6)), "takes 5 numbers, not 6"),
        "no focal length": (edit_npz(CALIB, intrinsics=np.zeros((3, 3))), "fx must be positive"),
        "NaN principal point": (edit_npz(CALIB, intrinsics=np.full((3, 3), np.nan)), "must be positive|must be finite"),
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
        "views are no JSON": (text(VIEWS, "{"), f"{VIEWS}: not valid JSON"),
        "no frames": (text(VIEWS, "{}"), "frames is missing"),
        "frame is a number": (text(VIEWS, '{"frames": [3]}'), r"frames\[0\] is 3, not an object"),
        "no image": (remove("views/val/r_1.png"), r"frames\[1\].file_path names ./val/r_1, of which there is no"),
        "scaled pose": (
            edit_json(VIEWS, lambda m: m["frames"][0].update(transform_matrix=SCALED)),
            "is not a rigid motion",
        ),
        "no pose": (edit_json(VIEWS, lambda m: m["frames"][0].pop("transform_matrix")), "transform_matrix is missing"),
        "no angle": (edit_json(VIEWS, lambda m: m.pop("camera_angle_x")), "intrinsics is missing"),
        "angle is 0": (edit_json(VIEWS, lambda m: m.update(camera_angle_x=0)), f"{VIEWS}: intrinsics: "),
        "other angle": (edit_json(VIEWS, lambda m: m.update(camera_angle_x=1)), "is not that of the other split"),
    },
    "tum-vie-data": {
        "no events": (remove("*.h5"), "mocap-desk2-events_left.h5: there is no such event file"),
        "no poses": (remove(f"{TRUTH}/mocap_data.txt"), "mocap_data.txt: there is no such file"),
        "no calibration": (remove("camera-*"), f"{CAMERAS}: there is no such file; download the dataset's calibration"),
        "no hand-eye": (remove("mocap-imu*"), f"{MOCAP}: there is no such file"),
        "pinhole": (
            edit_json(CAMERAS, lambda m: m["value0"]["intrinsics"][2].update(camera_type="ds")),
            r"value0.intrinsics\[2\].camera_type is 'ds', not 'kb4'",
        ),
        "one camera": (
            edit_json(CAMERAS, lambda m: m["value0"].update(T_imu_cam=m["value0"]["T_imu_cam"][:1])),
            "value0.T_imu_cam has 1 entries, not 3",
        ),
        "no k4": (
            edit_json(CAMERAS, lambda m: m["value0"]["intrinsics"][2]["intrinsics"].pop("k4")),
            r"value0.intrinsics\[2\].intrinsics.k4 is missing",
        ),
        "size is a word": (
            edit_json(CAMERAS, lambda m: m["value0"].update(resolution=["big"] * 4)),
            r"value0.resolution\[2\] is not a table of numbers|resolution\[2\] must be 2 finite",
        ),
        "long quaternion": (
            edit_json(MOCAP, lambda m: m["value0"]["T_imu_marker"].update(qw=3.0)),
            f"{MOCAP}: the quaternion of pose 0 has length 3",
        ),
        "no marker": (edit_json(MOCAP, lambda m: m["value0"].pop("T_imu_marker")), "value0.T_imu_marker is missing"),
        "NaN pose": (replace_line(f"{TRUTH}/mocap_data.txt", 3, "1 nan 0 0 0 0 0 1"), "pose 2 holds nan"),
        "seconds": (
            replace_line(f"{TRUTH}/mocap_data.txt", 1, "early 0 0 0 0 0 0 1"),
            "early is not a time in microseconds",
        ),
        "lost image": (remove(f"{TRUTH}/left_images/00001.jpg"), "it has 3 times for 2 images"),
        "no image times": (remove(f"{TRUTH}/left_images/*.txt"), "image_timestamps_left.txt: there is no such file"),
    },
    "eds-data": {
        "no poses": (remove("stamped*"), "stamped_groundtruth.txt: there is no such file"),
        "no events": (remove("events.h5"), "events.h5: there is no such event file"),
        "no column": (lambda folder: h5py.File(folder / "events.h5", "a").pop("p"), "there is no dataset /p"),
        "five images": (text("images_timestamps.txt", "1\n2\n3\n4\n5\n"), "it has 5 times for 3 images"),
        "image time is a word": (text("images_timestamps.txt", "1\ntwo\n3\n"), "two is not a time in microseconds"),
        "huge time": (text("images_timestamps.txt", "1\n2\n1e99999999\n"), "1e99999999 is not a time in microseconds"),
    },
    "enerf-esim-data": {
        "no events": (remove("events"), "events: there is no such folder of events"),
        "empty folder": (remove("events/*"), "events: it holds no .npy file"),
        "no camera": (remove("poses_bounds.npy"), "poses_bounds.npy: there is no such file"),
        "two lists": (text("other_poses_all.txt", ""), r"it holds 2 files \*poses_all\*.txt"),
        "small bounds": (
            lambda folder: np.save(folder / "poses_bounds.npy", np.zeros((12, 4))),
            r"poses_bounds.npy: it has type float64 and shape \(12, 4\)",
        ),
        "empty bounds": (lambda folder: np.save(folder / "poses_bounds.npy", np.zeros((12, 17))), "must be positive"),
        "NaN bounds": (
            lambda folder: np.save(folder / "poses_bounds.npy", np.full((12, 17), np.nan)),
            "poses_bounds.npy: cannot convert",
        ),
        "unsorted files": (lambda folder: (folder / "events/2.npy").rename(folder / "events/20.npy"), "sort the ev"),
        "text": (text("events/2.npy", "x y t p"), "2.npy: not a readable .npy file"),
    },
    "eventnerf-data": {
        "no events": (remove("train/events"), "events.npz: there is no such event file"),
        "two event files": (
            lambda folder: np.savez(folder / "train/events/b.npz"),
            "train/events: it holds 2 .npz files; there must be one",
        ),
        "no poses": (remove("train/pose/*"), "train/pose: it holds no .txt file"),
        "no split": (remove("train"), "there is no train/pose; give the folder of a scene"),
        "no intrinsics": (remove("train/intrinsics/*"), "train/intrinsics: it holds no .txt file"),
        "3 x 4": (text("train/pose/r_00003.txt", "1 " * 12), "r_00003.txt: it holds 12 numbers; it must hold 4 x 4"),
        "a word": (text("train/pose/r_00003.txt", "1 " * 15 + "one"), "r_00003.txt: not a number"),
        "NaN pose": (text("train/pose/r_00003.txt", "nan " * 16), "r_00003.txt: a number is not finite"),
        "mirrored": (
            text("train/pose/r_00003.txt", "1 0 0 0  0 1 0 0  0 0 -1 0  0 0 0 1"),
            "train/pose: pose 3 is not a rigid motion",
        ),
        "no focal length": (text("train/intrinsics/r_00000.txt", "0 " * 16), "fx must be positive"),
        "lost image": (remove("train/rgb/00003.png"), "train/rgb: it holds 20 images for 21 poses"),
        "lost test image": (remove("test/rgb/00001.png"), "test/rgb: it holds 1 images for 2 poses"),
        "one event time": (
            edit_npz("train/events/test_lego.npz", t=np.zeros(N_EVENTS, int)),
            "train/pose: pose 1 is at 0 ns, not after",
        ),
    },
    "paev3d-data": {
        "no events": (remove("H5_Files/Bunny/*"), "event.h5: there is no such event file"),
        "no poses": (remove("Render_info/Bunny/*.npz"), "Render_info/Bunny: it holds no .npz file"),
        "no intrinsics": (remove("Intrinsics/*"), "Intrinsics: it holds no .txt file"),
        "no camera": (
            lambda folder: np.savez(folder / "Render_info/Bunny/0002.npz", object_poses=[{"name": "Bunny"}]),
            "0002.npz: its object_poses hold no 'Camera'",
        ),
        "no pose": (
            lambda folder: np.savez(folder / "Render_info/Bunny/0002.npz", object_poses=[{"name": "Camera"}]),
            "0002.npz: its camera's pose has type object",
        ),
        "no object_poses": (
            lambda folder: np.savez(folder / "Render_info/Bunny/0002.npz", depth=np.zeros(3)),
            "0002.npz: its object_poses cannot be read",
        ),
        "text": (text("Render_info/Bunny/0002.npz", "pose"), "0002.npz: its object_poses cannot be read"),
        "lost image": (remove("Render_info/Bunny/00003.png"), "it holds 20 images for 21 poses"),
        "columns": (
            lambda folder: (
                remove("H5_Files/Bunny/*")(folder),
                h5py.File(folder / "H5_Files/Bunny/event.h5", "w").create_dataset("events", data=np.zeros((9, 3))),
            ),
            "event.h5: events has 3 columns; column 3 must hold p",
        ),
    },
    "event-recording-data": {
        "no folder": (lambda folder: shutil.rmtree(folder), "made: there is no such folder"),
        "no events": (remove("events.h5"), r"it holds 0 files events\{.raw,"),
        "two event files": (text("events.csv", ""), "it holds 2 files events"),
        "no calibration": (remove("calibration.json"), "it holds 0 of calibration.json and camchain.yaml"),
        "no poses": (remove("trajectory.txt"), "trajectory.txt: there is no such file"),
        "no JSON": (text("calibration.json", "fx"), "calibration.json: not valid JSON"),
        "no event camera": (text("calibration.json", "{}"), "calibration.json: event_camera is missing"),
        "negative threshold": (
            edit_json("calibration.json", lambda m: m["event_camera"].update(positive_contrast_threshold=-1)),
            "event_camera.sensor: positive_contrast_threshold must be",
        ),
        "unknown lens": (
            edit_json("calibration.json", lambda m: m["event_camera"].update(camera_model="FOV")),
            "event_camera.camera_model is 'FOV'",
        ),
        "unknown encoding": (
            edit_json("calibration.json", lambda m: m.update(image_encoding="log")),
            'image_encoding is "log"',
        ),
        "scaled mount": (
            edit_json("calibration.json", lambda m: m["event_camera"].update(T_frame_event=SCALED)),
            "T_frame_event: pose 0 is not a rigid motion",
        ),
        "missing image": (remove("images/00001.png"), "images.txt: it names images/00001.png, which does not exist"),
        "image without time": (text("images.txt", "00001.png\n"), "images.txt: line 1 has 1 fields"),
        "COLMAP without images.txt": (
            lambda folder: (remove("[ti]*.txt")(folder), (folder / "colmap").mkdir()),
            "images.txt: there is no such list of images",
        ),
        "empty COLMAP": (
            lambda folder: (remove("trajectory.txt")(folder), (folder / "colmap").mkdir()),
            "colmap: there is no COLMAP model",
        ),
        "COLMAP of other images": (
            lambda folder: (
                remove("trajectory.txt")(folder),
                write_colmap(folder / "colmap", make_poses(2), ["00000.png", "other.png"]),
            ),
            "images.txt: it lists other.png 0 times",
        ),
        "broken COLMAP": (
            lambda folder: (
                remove("trajectory.txt")(folder),
                (folder / "colmap").mkdir(),
                (folder / "colmap" / "images.bin").write_bytes(b"\1"),
            ),
            "colmap: not a COLMAP model",
        ),
        "unknown distortion": (
            lambda folder: (
                remove("calibration.json")(folder),
                (folder / "camchain.yaml").write_text(
                    yaml.dump({"cam0": {**CAMCHAIN["cam0"], "distortion_model": "fov"}})
                ),
            ),
            "camchain.yaml: cam0.distortion_model is 'fov', not one of radtan",
        ),
        "camchain of numbers": (
            lambda folder: (remove("calibration.json")(folder), (folder / "camchain.yaml").write_text("cam0: 3")),
            "camchain.yaml: not a list of cameras",
        ),
        "no YAML": (
            lambda folder: (remove("calibration.json")(folder), (folder / "camchain.yaml").write_text("{:")),
            "camchain.yaml: not valid YAML",
        ),
    },
}  # fmt: skip
EVERY_FAULT = [(name, fault) for name, faults in FAULTS.items() for fault in faults]


@pytest.mark.parametrize(("name", "fault"), EVERY_FAULT)
def test_malformed_datasets_are_one_clear_line(
    name: str, fault: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    change, message = FAULTS[name][fault]
    if name == "tum-vie-data":
        truth = write_tum_vie(tmp_path / "made", request.getfixturevalue("tum_vie_calibration"))
    else:
        truth = WRITERS[name](tmp_path / "made")
    change(truth.data)
    config = config_of(name, truth.data)
    with pytest.raises(DataError, match=message) as error:
        read_everything(config)
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)


def read_everything(config: EventDataParserConfig) -> None:
    outputs_of(config, "val")
    assert len(EventDataset(outputs_of(config)).pairs)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=6,
)


def damage(data: st.DataObject, value: object) -> object:
    """Replaces, drops or adds something somewhere in a tree of dictionaries and lists."""
    keys = list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
    if not keys or data.draw(st.integers(0, 5)) == 0:
        return data.draw(JSON)
    key = data.draw(st.sampled_from(keys))
    copy = dict(value) if isinstance(value, dict) else list(value)  # type: ignore[call-overload]
    if data.draw(st.integers(0, 5)) == 0:
        del copy[key]
    else:
        copy[key] = damage(data, copy[key])
    return copy


@settings(max_examples=3 * FUZZ_EXAMPLES, deadline=None)
@given(st.data())
def test_no_calibration_crashes_its_readers(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.getbasetemp() / "fuzzed"
    if not folder.exists():
        write_own(folder)
    yaml_file, json_file = folder.parent / "fuzzed.yaml", folder.parent / "fuzzed.json"
    yaml_file.write_text(yaml.dump(damage(data, CAMCHAIN)))
    json_file.write_text(json.dumps(damage(data, CALIBRATION)))
    for read in (
        lambda: read_camchain(yaml_file),
        lambda: recording_of(OwnRecordingDataParserConfig(data=folder, calibration=json_file)),
    ):
        try:
            read()
        except DataError as error:
            assert "\n" not in str(error)  # noqa: PT017


@settings(max_examples=3 * FUZZ_EXAMPLES, deadline=None)
@given(st.text(alphabet="0123456789.-+e#\n  nai²", max_size=60), st.booleans(), st.sampled_from(["s", "us", "ns"]))
def test_no_text_crashes_the_trajectory_reader(
    tmp_path_factory: pytest.TempPathFactory, content: str, begun: bool, unit: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.txt"
    path.write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 " * begun + content)
    try:
        read_tum_trajectory(path, unit)  # type: ignore[arg-type]
    except DataError as error:
        assert "\n" not in str(error)  # noqa: PT017


def test_images_are_thinned_out_within_the_time_window(tmp_path: Path) -> None:
    truth = write_own(tmp_path / "made")
    write_images(truth.data / "images", 200, (60, 40))
    start, length = START * 1_000, DURATION * 1_000
    stamps = seconds(start + np.linspace(0, length, 200).astype(np.int64))
    lines = [f"{stamp} images/{index:05d}.png\n" for index, stamp in enumerate(stamps)]
    (truth.data / "images.txt").write_text("".join(lines))
    config = config_of("event-recording-data", truth.data)
    assert [len(outputs_of(config, split).image_filenames) for split in ("val", "test")] == [20, 20]
    # A tenth of the time, and all of its images.
    window = {"start_time_ns": start + length // 2, "end_time_ns": start + length * 6 // 10}
    windowed = config_of("event-recording-data", truth.data, **window)
    assert [len(outputs_of(windowed, split).image_filenames) for split in ("val", "test")] == [10, 10]
    # Poses are estimated from all of them, also where there are none yet.
    assert len(config.setup().read_frames().images) == 200
    (truth.data / "trajectory.txt").unlink()
    frames = config.setup().read_frames()
    assert len(frames.images) == 200
    assert not isinstance(frames.capture, Recording)


def test_a_broken_image_is_one_clear_line(tmp_path: Path) -> None:
    truth = write_own(tmp_path / "made")
    (truth.data / "images" / "00001.png").write_bytes(b"no picture")
    with pytest.raises(DataError, match=r"00001.png: not an image that can be read"):
        outputs_of(config_of("event-recording-data", truth.data), "test")


def test_a_pose_gap_must_be_positive(tmp_path: Path) -> None:
    truth = write_own(tmp_path / "made")
    with pytest.raises(DataError, match="max_pose_gap_ns is 0"):
        outputs_of(config_of("event-recording-data", truth.data, max_pose_gap_ns=0))
