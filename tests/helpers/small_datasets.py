"""Small datasets in the native and the ECD format, and ways to damage them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from PIL import Image

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.recording.writer import NativeDatasetWriter
from helpers.dataset_faults import edit_json, remove, replace_line, write_text

CAMERA = CameraIntrinsics(6, 4, 5.0, 5.5, 3.0, 2.0, "radial_tangential", (0.01, 0.0, 0.001, 0.0, 0.0))
SENSOR = SensorModel(0.3, 0.2, 1000, "RGGB")
START, END = 1_600_000_000_000_000_001, 1_600_000_002_000_000_001


def make_trajectory() -> Trajectory:
    """21 poses, 0.1 s apart, that move by 0.3 along x, from above the z axis, with a slow turn."""
    angles = torch.linspace(0, 0.3, 21, dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(21, 1, 1)
    poses[:, 0, 0] = poses[:, 1, 1] = torch.cos(angles)
    poses[:, 0, 1] = -torch.sin(angles)
    poses[:, 1, 0] = torch.sin(angles)
    poses[:, 0, 3] = angles
    poses[:, 2, 3] = 2.0
    return Trajectory(START + 100_000_000 * np.arange(21), poses)


def write_native(folder: Path, scene_box: np.ndarray | None = None) -> Path:
    trajectory = make_trajectory()
    rng = np.random.default_rng(0)
    with NativeDatasetWriter(folder, CAMERA, SENSOR, "srgb", scene_box) as writer:
        t = np.sort(rng.integers(START, END + 1, 200))
        x, y = rng.integers(0, 6, 200).astype(np.uint16), rng.integers(0, 4, 200).astype(np.uint16)
        p = rng.choice(np.array([-1, 1], np.int8), 200)
        for part in (slice(0, 90), slice(90, 200)):
            writer.events.append(EventStream(x[part], y[part], t[part], p[part], 6, 4))
        writer.add_trajectories(trajectory, trajectory)
        picture = np.full((4, 6, 3), 77, np.uint8)
        for time in (START, START + 150_000_000, END):
            writer.add_image("train", picture, homogeneous(trajectory.interpolate(time)), time)
        writer.add_image("val", picture, homogeneous(trajectory.camera_to_worlds[3]))
        writer.add_image("test", picture + 1, homogeneous(trajectory.camera_to_worlds[4]))
        writer.add_image("test", picture + 2, homogeneous(trajectory.camera_to_worlds[5]))
    return folder


def write_ecd(folder: Path) -> Path:
    folder.mkdir()
    (folder / "images").mkdir()
    for index in range(4):
        Image.fromarray(np.full((4, 6), 40 * index, np.uint8)).save(folder / "images" / f"{index}.png")
    (folder / "images.txt").write_text("".join(f"{0.05 + 0.1 * i} images/{i}.png\n" for i in range(4)))
    (folder / "events.txt").write_text("0.01 1 2 1\n0.02 1 2 0\n0.03 5 3 1\n0.31 1 2 1\n")
    (folder / "calib.txt").write_text("5 5.5 2.5 1.5 0.01 0 0 0 0\n")
    (folder / "groundtruth.txt").write_text("".join(f"{0.1 * i} {0.02 * i} 0 0 0 0 0 1\n" for i in range(5)))
    return folder


AS_RECORDED = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}


def parse(config: DataParserConfig, split: str = "train") -> DataparserOutputs:
    return config.setup().get_dataparser_outputs(split)


ECD_FAULTS = {
    "no folder": (lambda folder: shutil.rmtree(folder), "made: there is no such folder"),
    "no events": (remove("events.txt"), "events.txt: there is no such file"),
    "no poses": (remove("groundtruth.txt"), "groundtruth.txt: there is no such file"),
    "no calibration": (remove("calib.txt"), "calib.txt: there is no such file"),
    "missing image": (remove("images/1.png"), "images.txt: it names images/1.png, which does not exist"),
    "empty stream": (write_text("events.txt", ""), "events.txt: the file holds no events"),
    "five fields": (replace_line("events.txt", 1, "0.02 1 2 0 9"), "events.txt: line 2 has 5 fields"),
    "a word": (replace_line("events.txt", 1, "0.02 one 2 0"), "events.txt: line 2 has x = one"),
    "signed polarity": (replace_line("events.txt", 1, "0.02 1 2 -1"), "line 2 has p = -1; .* 0 or 1"),
    "pixel outside": (replace_line("events.txt", 2, "0.03 6 3 1"), "line 3 has x = 6; .* below 6"),
    "negative pixel": (replace_line("events.txt", 2, "0.03 5 -1 1"), "line 3 has y = -1; .* below 4"),
    "fractional pixel": (replace_line("events.txt", 2, "0.03 2.5 1 1"), "line 3 has x = 2.5; .*whole number"),
    "time is NaN": (replace_line("events.txt", 2, "nan 2 1 1"), "line 3 has t = nan"),
    "unsorted": (replace_line("events.txt", 2, "0.015 2 1 1"), "event 2 is at 15000000 ns, before .* 20000000 ns"),
    "NaN pose": (replace_line("groundtruth.txt", 2, "0.2 nan 0 0 0 0 0 1"), "groundtruth.txt: pose 2 holds nan"),
    "long quaternion": (
        replace_line("groundtruth.txt", 2, "0.2 0 0 0 0 0 1 1"),
        "quaternion of pose 2 has length 1.414",
    ),
    "seven numbers": (replace_line("groundtruth.txt", 2, "0.2 0 0 0 0 0 1"), "line 3 has 7 fields; .* the 8: t tx"),
    "pose is a word": (replace_line("groundtruth.txt", 2, "0.2 x 0 0 0 0 0 1"), "groundtruth.txt: not a number .*'x'"),
    "pose time is a word": (replace_line("groundtruth.txt", 2, "now 0 0 0 0 0 0 1"), "now is not a time in seconds"),
    "unsorted poses": (replace_line("groundtruth.txt", 2, "0.05 0 0 0 0 0 0 1"), "pose 2 is at 50000000 ns, not after"),
    "one pose": (write_text("groundtruth.txt", "0 0 0 0 0 0 0 1\n"), "at least two timed poses"),
    "no pose": (write_text("groundtruth.txt", "# nothing\n"), "groundtruth.txt: the file holds no poses"),
    "no overlap": (
        write_text("groundtruth.txt", "5 0 0 0 0 0 0 1\n6 1 0 0 0 0 0 1\n"),
        "groundtruth.txt: .*do not overlap the events from 10000000 to 310000000 ns; check .* one clock",
    ),
    "short calibration": (
        write_text("calib.txt", "5 5.5 2.5 1.5\n"),
        "calib.txt: line 1 has 4 fields; .* the 9: fx",
    ),
    "empty calibration": (write_text("calib.txt", ""), "calib.txt: the file is empty"),
    "no focal length": (write_text("calib.txt", "0 5 2 1 0 0 0 0 0\n"), "calib.txt: fx must be from 0.01"),
}


def edit_transforms(edit: Callable[[dict], object]) -> Callable[[Path], None]:
    return edit_json("transforms.json", edit)


def replace_column(name: str, values: np.ndarray | None) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        with h5py.File(folder / "events.h5", "r+") as file:
            del file[f"events/{name}"]
            if values is not None:
                file[f"events/{name}"] = values

    return change


def resize_image(name: str) -> Callable[[Path], None]:
    return lambda folder: Image.new("RGB", (3, 2)).save(folder / name)


def empty_events(folder: Path) -> None:
    for name, dtype in (("x", np.uint16), ("y", np.uint16), ("t", np.int64), ("p", np.int8)):
        replace_column(name, np.zeros(0, dtype))(folder)


def set_attribute(name: str, value: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        with h5py.File(folder / "events.h5", "r+") as file:
            file["events"].attrs[name] = value

    return change


NATIVE_FAULTS = {
    "no transforms": (remove("transforms.json"), "transforms.json: there is no such file"),
    "no JSON": (write_text("transforms.json", "{"), "transforms.json: not valid JSON"),
    "a list": (write_text("transforms.json", "[]"), "expected `object`, got `array`"),
    "no event camera": (edit_transforms(lambda m: m.pop("event_camera")), "required field `event_camera`"),
    "no focal length": (
        edit_transforms(lambda m: m["event_camera"].pop("fl_x")),
        "required field `fl_x`",
    ),
    "width is a word": (
        edit_transforms(lambda m: m["event_camera"].update(width="wide")),
        "event_camera.width: expected `int`",
    ),
    "no threshold": (
        edit_transforms(lambda m: m["event_camera"].pop("positive_contrast_threshold")),
        "event_camera: missing field positive_contrast_threshold",
    ),
    "negative threshold": (
        edit_transforms(lambda m: m["event_camera"].update(negative_contrast_threshold=-1)),
        "negative_contrast_threshold must be from 0.0001",
    ),
    "unknown Bayer pattern": (edit_transforms(lambda m: m["event_camera"].update(bayer_pattern="GRBG")), '"GRBG"'),
    "unknown lens": (
        edit_transforms(lambda m: m["event_camera"].update(camera_model="KB4")),
        "event_camera: the lens model is 'KB4', not one",
    ),
    "image of another size": (resize_image("images/val/00000.png"), "00000.png: the image has 3 x 2 pixels"),
    "mirrored pose": (
        edit_transforms(lambda m: m["frames"][0].update(transform_matrix=np.diag([1.0, 1, -1, 1]).tolist())),
        r"frames\[0\].transform_matrix: pose 0 is not a rigid motion",
    ),
    "event camera that is scaled": (
        edit_transforms(lambda m: m["event_camera"].update(T_frame_event=np.diag([1e3, 1e3, 1e3, 1]).tolist())),
        r"event_camera.T_frame_event: pose 0 is not a rigid motion",
    ),
    "frame twice": (
        edit_transforms(lambda m: m["frames"].append(m["frames"][0])),
        r"names images/train/00000.png again",
    ),
    "unknown encoding": (
        edit_transforms(lambda m: m.update(image_encoding="log")),
        "invalid enum value 'log'",
    ),
    "box inside out": (edit_transforms(lambda m: m.update(scene_box=[[1, 1, 1], [0, 0, 0]])), "scene_box has corners"),
    "box is flat": (
        edit_transforms(lambda m: m.update(scene_box=[[1, 1, 1]])),
        "expected `array` of length 2",
    ),
    "missing image": (remove("images/val/00000.png"), "names images/val/00000.png, which does not exist"),
    "unknown split file": (
        edit_transforms(lambda m: m.update(test_filenames=["x.png"])),
        "names x.png, which is not among",
    ),
    "short matrix": (
        edit_transforms(lambda m: m["frames"][0].update(transform_matrix=[[1]])),
        r"frames\[0\].transform_matrix: expected `array` of length 4",
    ),
    "neither pose nor time": (
        edit_transforms(lambda m: [f.pop(k, None) for f in m["frames"] for k in ("transform_matrix", "timestamp")]),
        r"frames\[0\] has neither transform_matrix nor timestamp",
    ),
    "no events": (remove("events.h5"), "events.h5: there is no such file"),
    "not HDF5": (write_text("events.h5", "t x y p"), "events.h5: not a readable HDF5 file"),
    "no column": (replace_column("p", None), "there is no dataset /events/p"),
    "wrong dtype": (replace_column("t", np.zeros(200)), "/events/t has type float64 .*int64"),
    "short column": (replace_column("x", np.zeros(3, np.uint16)), "its columns have lengths"),
    "empty stream": (empty_events, "events.h5: the file holds no events"),
    "fractional offset": (set_attribute("time_offset", 0.5), "its time offset is 0.5"),
    "offset is NaN": (set_attribute("time_offset", np.nan), "its time offset is nan"),
    "unknown unit": (set_attribute("time_unit", "fortnight"), "its time unit is 'fortnight'; use one of ns, us, ms"),
    "polarity 0": (replace_column("p", np.zeros(200, np.int8)), r"event 0 has polarity 0; .*2 \* p - 1"),
    "pixel outside": (replace_column("x", np.full(200, 6, np.uint16)), "event 0 has x = 6 on a sensor of width 6"),
    "unsorted": (replace_column("t", START + 10**9 - np.arange(200)), "sort the events by time"),
    "no overlap": (replace_column("t", np.arange(200)), "trajectory_estimated.txt: .*do not overlap the events"),
    "no poses": (remove("trajectory_estimated.txt"), "trajectory_estimated.txt: there is no such file"),
}
