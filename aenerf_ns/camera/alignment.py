"""Distances between trajectories, after alignment of their worlds."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Similarity:
    """A map x -> scale · rotation · x + translation between two worlds, float64.

    Attributes:
        scale: factor on lengths.
        rotation: (3, 3). It may be a rotation in single precision only: :meth:`inverse` is exact nevertheless.
        translation: (3,), in the units of the target.
    """

    scale: Tensor
    rotation: Tensor
    translation: Tensor

    def __call__(self, poses: Tensor) -> Tensor:
        """Map (..., 3, 4) camera-to-world poses to the target's world."""
        rotations = self.rotation @ poses[..., :3]
        return torch.cat([rotations, self.map_points(poses[..., 3])[..., None]], -1)

    def map_points(self, points: Tensor) -> Tensor:
        """Map points (..., 3) to the target's world."""
        return self.scale * points @ self.rotation.mT + self.translation

    def inverse(self) -> Similarity:
        """Return the inverse map."""
        rotation, scale = torch.linalg.inv(self.rotation), 1 / self.scale
        return Similarity(scale, rotation, -scale * (rotation @ self.translation))


# Squared spread of positions that is rounding. Such positions tell nothing.
_ROUNDING = 1e-24
# Rounds of weighted least squares. Ten are enough for poses by COLMAP.
_ROUNDS = 20
# Distance below which all cameras are equally good.
_NEGLIGIBLE = 1e-4


def align(
    poses: Tensor,
    reference: Tensor,
    with_scale: bool = True,
    with_orientations: bool = True,
    weights: Tensor | None = None,
) -> Similarity:
    """Return the least-squares map of poses onto reference poses of the same cameras at the same times.

    Positions alone leave the rotation uncertain, and on a straight line undetermined. So each camera contributes its
    position, in units of the root mean square distance of all positions from their mean, and the three axes of its
    orientation, each with the weight of the position.

    Args:
        poses: (N, 3, 4) camera-to-world.
        reference: (N, 3, 4) camera-to-world, with the same camera axes.
        with_scale: Sim(3) if true, else SE(3).
        with_orientations: if false, positions alone count (Umeyama 1991), as is usual for the absolute trajectory
            error.
        weights: (N,) of the cameras' squared errors, or None for equal ones.

    Returns:
        The map from the world of ``poses`` to the world of ``reference``.

    Example:
        >>> poses = torch.eye(4)[:3].repeat(3, 1, 1)
        >>> poses[:, :, 3] = torch.eye(3)
        >>> reference = poses.clone()
        >>> reference[:, :, 3] = 2 * poses[:, :, 3] + 1
        >>> similarity = align(poses, reference)
        >>> round(similarity.scale.item(), 3)
        2.0
        >>> torch.allclose(similarity(poses.double()), reference.double())
        True
    """
    poses, reference = poses.double(), reference.double()
    weights = poses.new_ones(len(poses)) if weights is None else weights
    weights = (weights / weights.sum())[:, None]
    mean, reference_mean = (weights * poses[..., 3]).sum(0), (weights * reference[..., 3]).sum(0)
    centered, reference_centered = poses[..., 3] - mean, reference[..., 3] - reference_mean
    variance, reference_variance = ((weights * part.square()).sum() for part in (centered, reference_centered))
    correlation = (weights * reference_centered).mT @ centered
    spreads = min(variance, reference_variance) > _ROUNDING
    if with_orientations:
        correlation = correlation / (variance * reference_variance).sqrt() if spreads else torch.zeros_like(correlation)
        correlation = correlation + (weights[..., None] * (reference[..., :3] @ poses[..., :3].mT)).sum(0)
    u, _, vh = torch.linalg.svd(correlation)
    sign = torch.ones(3, dtype=torch.float64, device=poses.device)
    sign[2] = torch.linalg.det(u @ vh).sign()
    rotation = u @ (sign[:, None] * vh)
    scale = torch.ones((), dtype=torch.float64, device=poses.device)
    # Positions that do not spread give no scale.
    if with_scale and spreads:
        scale = (weights * reference_centered * (centered @ rotation.mT)).sum() / variance
        if scale <= 0:
            # The positions contradict the orientations. A negative factor would be a reflection.
            scale = (reference_variance / variance).sqrt()
    return Similarity(scale, rotation, reference_mean - scale * (rotation @ mean))


def align_most(poses: Tensor, reference: Tensor) -> Similarity:
    """Return the Sim(3) that leaves nearly the least sum of the cameras' distances.

    :func:`align` leaves the least sum of their squares, so a few misplaced cameras move all others away from their
    places. Here they hardly do, unless one lies a hundred extents away. A camera's distance is the root of the squares
    of its three axes' errors and of its position's, in units of the reference's spread. The least squares are repeated
    with weights of 1 / distance.

    Args:
        poses: (N, 3, 4) camera-to-world.
        reference: (N, 3, 4) camera-to-world, with the same camera axes.

    Returns:
        The map from the world of ``poses`` to the world of ``reference``.
    """
    poses, reference = poses.double(), reference.double()
    variance = (reference[..., 3] - reference[..., 3].mean(0)).square().sum(-1).mean()
    # The positions of a camera that only turns do not count.
    units = poses.new_tensor([1.0, 1.0, 1.0, 1 / variance.sqrt() if variance > _ROUNDING else 0.0])
    similarity = align(poses, reference)
    for _ in range(_ROUNDS):
        distances = (units * (similarity(poses) - reference)).square().sum((1, 2)).sqrt()
        similarity = align(poses, reference, weights=1 / distances.clamp_min(_NEGLIGIBLE))
    return similarity


def pose_errors(poses: Tensor, reference: Tensor) -> dict[str, float]:
    """Return errors of poses against reference poses of the same cameras at the same times.

    Args:
        poses: (N, 3, 4) camera-to-world.
        reference: (N, 3, 4) camera-to-world, with the same camera axes.

    Returns:
        After alignment by :func:`align` with positions and orientations: means over the poses
        ``rotation_error_degrees`` and ``translation_error`` after Sim(3), and the same names with ``_se3`` after
        SE(3); ``translation_error_percent``, the former in per cent of the length of the reference trajectory; and the
        absolute trajectory error, the root mean square of the position errors after alignment of positions alone,
        ``ate_rmse_sim3`` and ``ate_rmse_se3``. Translation errors are in the units of the reference.
    """
    poses, reference = poses.double(), reference.double()
    errors = {}
    for name, with_scale in (("", True), ("_se3", False)):
        aligned = align(poses, reference, with_scale)(poses)
        errors[f"rotation_error_degrees{name}"] = torch.rad2deg(rotation_angle(aligned, reference)).mean()
        errors[f"translation_error{name}"] = (aligned - reference)[..., 3].norm(dim=-1).mean()
    length = reference[..., 3].diff(dim=0).norm(dim=-1).sum()
    errors["translation_error_percent"] = 100 * errors["translation_error"] / length.clamp_min(1e-30)
    for name, with_scale in (("sim3", True), ("se3", False)):
        aligned = align(poses, reference, with_scale, with_orientations=False)(poses)
        errors[f"ate_rmse_{name}"] = (aligned - reference)[..., 3].square().sum(-1).mean().sqrt()
    return dict(zip(errors, torch.stack(list(errors.values())).tolist(), strict=True))


def rotation_angle(poses: Tensor, reference: Tensor) -> Tensor:
    """Return the (N,) angles in radians between the orientations of (N, 3, 4) poses. Small angles are exact too."""
    relative = reference[..., :3].mT @ poses[..., :3]
    # The norm of the difference to the identity is sqrt(2) · 2 sin(angle / 2): no cancellation at small angles.
    identity = torch.eye(3, dtype=poses.dtype, device=poses.device)
    chord = (relative - identity).flatten(-2).norm(dim=-1) / 8**0.5
    return 2 * torch.asin(chord.clamp(max=1))
