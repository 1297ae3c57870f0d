"""The corrected poses of a run: their errors, and how fast the camera moves."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from aenerf_ns.camera.alignment import pose_errors
from aenerf_ns.method.pose_correction import PoseCorrection
from aenerf_ns.recording.scene import SceneRecording


def compare_with_ground_truth(correction: PoseCorrection, scene: SceneRecording) -> dict[str, dict[str, float]] | None:
    """Compute the :func:`~aenerf_ns.camera.alignment.pose_errors` of the ``estimated`` and of the ``corrected`` poses.

    They are in units of the recording, and None where the true poses are not known.
    """
    if not correction.has_ground_truth:
        return None
    estimated, corrected, reference = (scene.to_recording(poses) for poses in correction.compared_poses())
    return {"estimated": pose_errors(estimated, reference), "corrected": pose_errors(corrected, reference)}


@torch.no_grad()
def camera_speeds(correction: PoseCorrection, scene: SceneRecording, seconds: Tensor) -> tuple[Tensor, Tensor]:
    """Compute how fast the corrected camera moves and turns at (N,) float64 seconds since the trajectory's start.

    Returns:
        (N,) units of the recording's true poses, or where they are not known of its poses, per second, and (N,) degrees
        per second.
    """
    pose, rate = correction.pose_and_rate(seconds.to(correction.trajectory.times.device))
    # The derivative of a rotation R is R [ω]ₓ, whose norm is √2 |ω|.
    turning = (pose[..., :3].mT @ rate[..., :3]).flatten(1).norm(dim=-1) / math.sqrt(2)
    speed = correction.alignment().scale * rate[..., 3].norm(dim=-1) / scene.scale
    return speed.cpu(), torch.rad2deg(turning).cpu()


def describe_test_poses(correction: PoseCorrection) -> str:
    """Say how the cameras of the reference views are placed."""
    if correction.has_ground_truth:
        return "Sim(3) of the corrected to the true trajectory"
    if not correction.is_learned:
        return "as the dataset gives them"
    return "corrected pose at the time of the view, else Sim(3) of the corrected to the estimated trajectory"
