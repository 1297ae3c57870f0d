"""Estimate poses from the frames of a simulated camera, by structure from motion, and measure their errors."""

from __future__ import annotations

from typing import Any

import torch

from aenerf_ns.camera.alignment import pose_errors
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.pose_estimation.from_frames import compare_with_truth, estimate_poses
from aenerf_ns.simulator.simulation import Simulation


def estimate_simulated_poses(
    simulation: Simulation, camera: CameraIntrinsics, truth: Trajectory, frame_rate: float, exposure: float, seed: int
) -> tuple[Trajectory, dict[str, Any], str]:
    """Run COLMAP on the frames of a camera at the event sensor's position, as in a DAVIS.

    The truth provides only what pictures cannot: the position, orientation and scale of the world.

    Args:
        simulation, camera, truth: the pass of the camera, its lens and its true trajectory.
        frame_rate: frames a second.
        exposure: seconds for which a frame is exposed. Motion blurs the frame meanwhile.
        seed: of COLMAP.

    Returns:
        the estimated trajectory, a report of its making and its errors, and a summary in words.

    Raises:
        ValueError: frame rate and exposure do not fit each other or the path.
        DataError: COLMAP finds no poses.
    """
    times = simulation.frame_times(frame_rate, exposure)
    frames = (simulation.blurred_frame(int(time), exposure) for time in times)
    found = estimate_poses(frames, times, camera, "frames of aenerf simulate", seed)
    true_poses = torch.stack([simulation.pose(time)[:3] for time in found.trajectory.times.tolist()])
    estimated, errors = compare_with_truth(found.trajectory, true_poses)
    knots = truth.knots_between(estimated.start, estimated.end)
    if len(knots) < 2:
        raise DataError(
            "aenerf simulate",
            f"COLMAP's poses span {len(estimated)} frames, and fewer than two of the true poses",
            "give a higher --pose-rate",
        )
    between = pose_errors(estimated.interpolate(knots), truth.interpolate(knots))
    settings = {"frame_rate": frame_rate, "exposure_seconds": exposure}
    report = {**settings, **found.report(), "errors": errors, "errors_between_frames": between}
    summary = (
        f"{found.summary()}\nMean errors {errors['rotation_error_degrees']:.2f} degrees and "
        f"{errors['translation_error']:.2g} m at the frames, {between['rotation_error_degrees']:.2f} degrees and "
        f"{between['translation_error']:.2g} m interpolated between them; {errors['misplaced_frames']} frames "
        f"misplaced, {errors['flipped_frames']} of them flipped."
    )
    return estimated, report, summary
