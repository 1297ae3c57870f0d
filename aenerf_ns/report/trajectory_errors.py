"""Errors of trajectories as evo computes them, and over time."""

from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from aenerf_ns.camera.alignment import align, rotation_angle
from aenerf_ns.camera.trajectory import homogeneous


def error_statistics(errors: Tensor) -> dict[str, float]:
    """Compute the statistics of (N,) errors that evo prints, under evo's names."""
    return {
        "max": float(errors.max()),
        "mean": float(errors.mean()),
        # torch.median would take the lower of two middle values.
        "median": float(errors.quantile(0.5)),
        "min": float(errors.min()),
        "rmse": float(errors.square().mean().sqrt()),
        "sse": float(errors.square().sum()),
        "std": float(errors.std(correction=0)),
    }


def evo_errors(poses: Tensor, reference: Tensor) -> dict[str, dict[str, float]]:
    """Compute ATE and RPE of poses, aligned by Sim(3) on their positions, as ``evo_ape -as`` and ``evo_rpe -as`` do.

    Args:
        poses: (N, 3, 4) camera-to-world.
        reference: (N, 3, 4) of the same cameras at the same times.

    Returns:
        The :func:`error_statistics` of the absolute errors ``ate``, of the relative errors from a pose to the next
        ``rpe_translation``, both in units of the reference, and ``rpe_rotation_degrees``.
    """
    aligned = homogeneous(align(poses, reference, with_orientations=False)(poses.double()))
    reference = homogeneous(reference.double())
    steps, true_steps = (torch.linalg.solve(path[:-1], path[1:]) for path in (aligned, reference))
    relative = torch.linalg.solve(true_steps, steps)
    return {
        "ate": error_statistics((aligned - reference)[:, :3, 3].norm(dim=-1)),
        "rpe_translation": error_statistics(relative[:, :3, 3].norm(dim=-1)),
        "rpe_rotation_degrees": error_statistics(torch.rad2deg(rotation_angle(steps[:, :3], true_steps[:, :3]))),
    }


def errors_over_time(poses: Tensor, reference: Tensor) -> dict[str, list[float]]:
    """Compute the errors ``rotation_degrees`` and ``translation`` of each pose, after alignment by whole poses."""
    aligned, reference = align(poses, reference)(poses.double()), reference.double()
    return {
        "rotation_degrees": torch.rad2deg(rotation_angle(aligned, reference)).tolist(),
        "translation": (aligned - reference)[..., 3].norm(dim=-1).tolist(),
    }


def correction_components(estimated: Tensor, corrected: Tensor) -> dict[str, list[float]]:
    """Compute the six components of the motion from estimated to corrected poses, in the camera's frame.

    Args:
        estimated: (N, 3, 4) camera-to-world.
        corrected: (N, 3, 4) at the same times.

    Returns:
        By name: translations in the units of the poses, and the rotation's vector in degrees.
    """
    motion = torch.linalg.solve(homogeneous(estimated.double()), homogeneous(corrected.double()))
    vectors = Rotation.from_matrix(motion[:, :3, :3].cpu().numpy()).as_rotvec(degrees=True)
    named = {f"translation {axis}": motion[:, i, 3] for i, axis in enumerate("xyz")}
    named |= {f"rotation {axis}": vectors[:, i] for i, axis in enumerate("xyz")}
    return {name: values.tolist() for name, values in named.items()}
