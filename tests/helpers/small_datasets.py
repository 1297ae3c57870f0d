"""Small datasets in the native and the ECD format."""

from pathlib import Path

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from PIL import Image

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.recording import Recording
from aenerf_ns.recording.writer import NativeDatasetWriter
from helpers.streams import random_stream

CAMERA = CameraIntrinsics(6, 4, 5.0, 5.5, 3.0, 2.0, "radial_tangential", (0.01, 0.0, 0.001, 0.0, 0.0))
SENSOR = SensorModel(0.3, 0.2, 1000, "RGGB", 300.0)
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
    events = random_stream(200, 6, 4, END + 1, start=START)
    with NativeDatasetWriter(folder, CAMERA, SENSOR, "srgb", scene_box) as writer:
        writer.events.append(events[:90])
        writer.events.append(events[90:])
        writer.add_trajectories(trajectory, trajectory)
        picture = np.full((4, 6, 3), 77, np.uint8)
        for time in (START, START + 150_000_000, END):
            writer.add_image("train", picture, trajectory.interpolate(time), time)
        writer.add_image("val", picture, trajectory.camera_to_worlds[3])
        writer.add_image("test", picture + 1, trajectory.camera_to_worlds[4])
        writer.add_image("test", picture + 2, trajectory.camera_to_worlds[5])
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


def read_native(folder: Path) -> Recording:
    return NativeDataParserConfig(data=folder).setup().recording


AS_RECORDED = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}


def parse(config: DataParserConfig, split: str = "train") -> DataparserOutputs:
    return config.setup().get_dataparser_outputs(split)
