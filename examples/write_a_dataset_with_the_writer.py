"""Write a dataset folder with the package's writer, which keeps every digit of Unix times."""

from pathlib import Path

import numpy as np
import torch

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.recording.writer import NativeDatasetWriter

rng = np.random.default_rng(0)
n, width, height = 20_000, 64, 48
start = 1_600_000_000_000_000_000  # Unix time, in nanoseconds
poses = torch.eye(4, dtype=torch.float64).repeat(26, 1, 1)  # camera-to-world, OpenCV axes
poses[:, 0, 3] = 0.004 * torch.arange(26, dtype=torch.float64)
poses[:, 2, 3] = -2
trajectory = Trajectory(start + 40_000_000 * np.arange(26), poses)
camera = CameraIntrinsics(width, height, 60.0, 60.0, width / 2, height / 2, "radial_tangential", (-0.1, 0.02, 0, 0, 0))
sensor = SensorModel(0.25, 0.25, refractory_period=1000)

with NativeDatasetWriter(Path("scene_from_writer"), camera, sensor, image_encoding="srgb") as writer:
    writer.add_trajectories(estimated=trajectory)
    events = EventStream(
        x=rng.integers(0, width, n).astype(np.uint16),
        y=rng.integers(0, height, n).astype(np.uint16),
        t=np.sort(rng.integers(start, trajectory.end, n)),
        p=(2 * rng.integers(0, 2, n) - 1).astype(np.int8),
        width=width,
        height=height,
    )
    writer.events.append(events)  # as often as you like, in the order of time
    picture = np.full((height, width, 3), 100, np.uint8)
    time = start + 500_000_001
    writer.add_image("val", picture, trajectory.interpolate(time), time)
    writer.add_image("test", picture, trajectory.camera_to_worlds[7])
