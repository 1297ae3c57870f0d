"""Datasets of other projects, written in the layout they are published in."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from aenerf_ns.dataparsers.formats import FORMATS
from aenerf_ns.recording.options import EventDataParserConfig
from aenerf_ns.recording.recording import Recording
from helpers import event_table_writers

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
N_POSES, N_EVENTS = 21, 200
# Microseconds since 1970, where a format has absolute times.
EPOCH = 1_600_000_000_000_000
DURATION = 2_000_000


@dataclass(frozen=True)
class Truth:
    """The content of a written dataset: OpenCV camera-to-world poses (N, 4, 4) with times in ns, events, the lens in
    OpenCV's terms, and the name of the format in tests of every format."""

    data: Path
    times: NDArray[np.int64]
    poses: NDArray[np.float64]
    events: dict[str, NDArray]
    width: int
    height: int
    matrix: NDArray[np.float64]
    distortion: tuple[float, ...]
    fisheye: bool = False
    format: str = ""


def make_poses(count: int = N_POSES) -> NDArray[np.float64]:
    """A turn about an axis that is no axis of the world, and a motion along another curve."""
    way = np.linspace(0, 1, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    turns = np.array([0.1, 2.0, -0.3]) + np.outer(way, [0.5, -0.7, 0.4])
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    poses[:, :3, 3] = np.stack([0.5 * way, 0.3 * np.sin(3 * way), 0.1 + way**2], 1)
    return poses


def pinhole(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def make_times(start: int = 0, count: int = N_POSES) -> NDArray[np.int64]:
    """Nanoseconds, from a start in microseconds."""
    return start * 1_000 + np.linspace(0, DURATION * 1_000, count).astype(np.int64)


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


def unsigned(events: dict[str, NDArray]) -> dict[str, NDArray]:
    """The columns with polarities of 0 and 1."""
    return {**events, "p": (events["p"] > 0).astype(np.uint8)}


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
    times = make_times()
    matrix = pinhole(50.0, 52.0, 29.25, 20.5)
    distortion = np.array([-0.05, 0.01, 0.002, -0.001])
    event_table_writers.write_robust_enerf(folder / "raw_events.npz", unsigned(events))
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
    for split in ("val", "test"):
        place = folder / views
        (place / split).mkdir(parents=True)
        frames = []
        for index in range(2):
            picture = np.full((30, 50, 4), [200, 100, 0, 51], np.uint8)
            Image.fromarray(picture).save(place / split / f"r_{index}.png")
            pose = (poses[index] @ FLIP).tolist()
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose})
        (place / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    return Truth(folder, times, poses, events, width, height, matrix, tuple(distortion), model == "equidistant")


def tum_vie_matrix(values: dict[str, float]) -> NDArray[np.float64]:
    """The (4, 4) pose in TUM-VIE's calibration."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([values[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
    pose[:3, 3] = [values[name] for name in ("px", "py", "pz")]
    return pose


def write_tum_vie_calibration(folder: Path) -> None:
    """Calibration A in the form of the real one."""
    poses, names = make_poses(5), ("px", "py", "pz", "qx", "qy", "qz", "qw")
    rows = np.concatenate([poses[:, :3, 3], quaternions(poses)], 1).tolist()
    marker, *mounts = (dict(zip(names, row, strict=True)) for row in rows)
    lens = {"fx": 1040.0, "fy": 1041.0, "cx": 634.0, "cy": 263.0, "k1": -0.1, "k2": 0.05, "k3": 0.01, "k4": -0.002}
    cameras = {
        "T_imu_cam": mounts,
        "intrinsics": [{"camera_type": "kb4", "intrinsics": lens}] * 4,
        "resolution": [[1024, 1024]] * 2 + [[1280, 720]] * 2,
    }
    for name, values in (("camera", cameras), ("mocap-imu", {"T_imu_marker": marker})):
        (folder / f"{name}-calibrationA.json").write_text(json.dumps({"value0": values}))


def write_tum_vie(
    folder: Path, calibration: Path | None = None, sequence: str = "mocap-desk2", side: str = "left"
) -> Truth:
    folder.mkdir(exist_ok=True)
    if calibration is None:
        write_tum_vie_calibration(folder)
    else:
        shutil.copytree(calibration, folder, dirs_exist_ok=True)
    index = {"left": 2, "right": 3}[side]
    which = "A" if "desk2" in sequence else "B"
    cameras = json.loads((folder / f"camera-calibration{which}.json").read_text())["value0"]
    mocap = json.loads((folder / f"mocap-imu-calibration{which}.json").read_text())["value0"]

    poses = make_poses(241)
    times = make_times(EPOCH, 241)
    # T_world_camera = T_world_marker inv(T_imu_marker) T_imu_camera, solved for the marker.
    imu_camera, imu_marker = tum_vie_matrix(cameras["T_imu_cam"][index]), tum_vie_matrix(mocap["T_imu_marker"])
    truth = folder / f"{sequence}-vi_gt_data"
    truth.mkdir(exist_ok=True)
    markers = poses @ np.linalg.inv(imu_camera) @ imu_marker
    times -= times % 1_000
    write_poses(truth / "mocap_data.txt", markers, (times // 1_000).astype(str).tolist(), "# timestamp[us] p q\n")
    events = make_events(1280, 720, EPOCH)
    event_table_writers.write_tum_vie(folder / f"{sequence}-events_{side}.h5", unsigned(events))
    write_images(truth / f"{side}_images", 3, (1024, 1024), "{:05d}.jpg")
    stamps = [EPOCH + 100_000, EPOCH + 333_333, EPOCH + 1_900_000]
    (truth / f"{side}_images" / f"image_timestamps_{side}.txt").write_text("\n".join(map(str, stamps)) + "\n")
    lens = cameras["intrinsics"][index]["intrinsics"]
    matrix = pinhole(*(lens[name] for name in ("fx", "fy", "cx", "cy")))
    distortion = tuple(lens[name] for name in ("k1", "k2", "k3", "k4"))
    return Truth(folder, times, poses, events, 1280, 720, matrix, distortion, fisheye=True)


EDS_MATRIX = pinhole(560.8520948927032, 560.6295819972383, 313.00733235019237, 217.32858679842997)
EDS_DISTORTION = (-0.09776467241921379, 0.2143738428636279, -0.004710710105172864, -0.004215916089401789)


def write_eds(folder: Path) -> Truth:
    folder.mkdir()
    poses, times = make_poses(), make_times(EPOCH)
    events = make_events(640, 480, EPOCH)
    event_table_writers.write_eds(folder / "events.h5", unsigned(events))
    write_poses(folder / "stamped_groundtruth.txt", poses, seconds(times), "# t p q\n")
    write_images(folder / "images", 3, (640, 480), "frame_{:010d}.png")
    stamps = [EPOCH + 50_000, EPOCH + 800_000, EPOCH + 1_700_000]
    (folder / "images_timestamps.txt").write_text("\n".join(map(str, stamps)) + "\n")
    return Truth(folder, times, poses, events, 640, 480, EDS_MATRIX, EDS_DISTORTION)


def write_enerf_esim(folder: Path) -> Truth:
    (folder / "events").mkdir(parents=True)
    width, height, focal = 64, 48, 70.0
    poses, times = make_poses(), make_times()
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
    matrix = pinhole(focal, focal, width / 2, height / 2)
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
    # Written with the center of the first pixel at 0, as OpenCV has it.
    matrix = pinhole(400.0, 410.0, 169.5, 128.0)
    return Truth(folder, times, poses, events, 346, 260, matrix, (-0.1, 0.02, 0.0, 0.0))


def write_paev3d(folder: Path) -> Truth:
    poses, events = make_poses(), make_events(640, 480, start=777)
    (folder / "H5_Files" / "Bunny").mkdir(parents=True)
    (folder / "Render_info" / "Bunny").mkdir(parents=True)
    event_table_writers.write_paev3d(folder / "H5_Files" / "Bunny" / "event.h5", unsigned(events))
    for index, pose in enumerate(poses):
        objects = [{"name": "Bunny", "pose": np.eye(4)}, {"name": "Camera", "pose": pose @ FLIP}]
        np.savez(folder / "Render_info" / "Bunny" / f"{index:04d}.npz", object_poses=objects, depth_map=np.zeros(3))
    write_images(folder / "Render_info" / "Bunny", N_POSES, (640, 480))
    write_matrices(
        folder / "Intrinsics", np.array([[[500.0, 0, 320, 0], [0, 500, 240, 0], [0, 0, 1, 0], [0, 0, 0, 1]]])
    )
    times = np.array([777_000 + 2_000_000_000 * i // 20 for i in range(N_POSES)])
    matrix = pinhole(500.0, 500.0, 319.5, 239.5)
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
    poses, times = make_poses(), make_times(EPOCH)
    events = make_events(60, 40, EPOCH)
    event_table_writers.write_dsec(folder / "events.h5", unsigned(events))
    write_poses(folder / "trajectory.txt", poses, seconds(times))
    (folder / "calibration.json").write_text(json.dumps(CALIBRATION))
    write_images(folder / "images", 4, (60, 40))
    stamps = seconds(EPOCH * 1_000 + np.array([0, 5 * 10**8, 10**9, 9 * 10**9]))
    lines = [f"{stamp} images/{index:05d}.png\n" for index, stamp in enumerate(stamps)]
    (folder / "images.txt").write_text("".join(lines))
    matrix = pinhole(50.0, 51.0, 29.5, 20.0)
    return Truth(folder, times, poses, events, 60, 40, matrix, (-0.1, 0.0, 0.0, 0.01))


CAMCHAIN = {
    "cam0": {
        "camera_model": "pinhole", "distortion_model": "equidistant", "intrinsics": [70.0, 71.0, 40.0, 30.0],
        "resolution": [80, 60], "distortion_coeffs": [0.01, 0.02, 0.03, 0.04], "rostopic": "/frames",
    },
    "cam1": {
        "camera_model": "pinhole", "distortion_model": "radtan", "intrinsics": [50.0, 51.0, 29.5, 20.0],
        "resolution": [60, 40], "distortion_coeffs": [-0.1, 0.0, 0.0, 0.01], "T_cn_cnm1": make_poses(3)[2].tolist(),
    },
}  # fmt: skip


def write_colmap(folder: Path, poses: NDArray[np.float64], names: list[str], binary: bool = False) -> None:
    """Write a model in COLMAP's text format, or in its binary one, where each image has two features."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=60, height=40, params=[50, 51, 30, 20.5])
    model.add_camera_with_trivial_rig(camera)
    for index, (pose, name) in enumerate(zip(poses, names, strict=True), start=1):
        image = pycolmap.Image(name=name, keypoints=np.ones((2 * binary, 2)), camera_id=1, image_id=index)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(pose)[:3]))
    folder.mkdir(parents=True)
    (model.write_binary if binary else model.write_text)(folder)


WRITERS: dict[str, Callable[[Path], Truth]] = {
    "robust-enerf-data": write_robust_enerf,
    "tum-vie-data": write_tum_vie,
    "eds-data": write_eds,
    "enerf-esim-data": write_enerf_esim,
    "eventnerf-data": write_eventnerf,
    "paev3d-data": write_paev3d,
    "event-recording-data": write_own,
}


def config_of(name: str, data: Path, **options: object) -> EventDataParserConfig:
    return replace(FORMATS[name], data=data, **options)


def recording_of(config: EventDataParserConfig) -> Recording:
    return config.setup().recording


def assert_same_poses(actual: torch.Tensor, expected: NDArray[np.float64], tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(actual[:, :3].numpy(), expected[:, :3], rtol=0, atol=tolerance)
