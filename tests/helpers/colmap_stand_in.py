"""Stand-ins for COLMAP, in tests of commands, and for its models. COLMAP itself is tested elsewhere."""

from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import torch

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.pose_estimation.placement import EstimatedPoses

FOUND_BOX = torch.tensor([[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]], dtype=torch.float64)


def model_of(*seen: range) -> SimpleNamespace:
    """A model of frames that see ranges of points."""
    images = {
        index: SimpleNamespace(
            name=f"{index:08d}.png",
            has_pose=True,
            num_points3D=len(points),
            points2D=[SimpleNamespace(point3D_id=point, has_point3D=lambda: True) for point in points],
            cam_from_world=pycolmap.Rigid3d,
        )
        for index, points in enumerate(seen)
    }
    return SimpleNamespace(images=images, compute_mean_reprojection_error=lambda: 0.5)


def place_frames(num_placed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let COLMAP place the first frames along a straight line, and estimate a lens where it is asked for one."""

    def place(frames, times, camera, source, seed, folder=None, adjusted=True) -> EstimatedPoses:
        assert len(list(frames)) == len(times)
        if not isinstance(camera, CameraIntrinsics):
            camera = CameraIntrinsics(*camera, 22.0, 22.0, 12.0, 8.0, distortion=(0.01, 0.0, 0.0, 0.0, 0.0))
        poses = torch.eye(4, dtype=torch.float64).repeat(num_placed, 1, 1)
        poses[:, 0, 3] = torch.arange(num_placed)
        trajectory = Trajectory(times[:num_placed], poses, source)
        return EstimatedPoses(np.array(times), trajectory, camera, [num_placed], 9, 0.5, 100.0, 1.0, FOUND_BOX)

    monkeypatch.setattr("aenerf_ns.pose_estimation.from_frames.estimate_poses", place)
