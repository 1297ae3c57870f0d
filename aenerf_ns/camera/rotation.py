"""Rotations as vectors, matrices and quaternions, in torch, differentiable everywhere including at zero angle.

The exponential maps of roma and Nerfstudio are not smooth to second order at zero, so they are not used.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Below this squared angle the series of sin and cos are exact to the last bit of float64.
_SMALL = 1e-4


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Return the exponential of so(3) (Rodrigues' formula).

    Args:
        vector: (..., 3) axis times angle in radians.

    Returns:
        (..., 3, 3) rotation matrices. Both the value and all derivatives are finite at zero.
    """
    a, b, _ = _exponential_coefficients(vector)
    cross = cross_matrix(vector)
    return torch.eye(3, dtype=vector.dtype, device=vector.device) + a * cross + b * (cross @ cross)


def _exponential_coefficients(vector: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sin θ / θ, (1 − cos θ) / θ² and (θ − sin θ) / θ³, each (..., 1, 1).

    θ is the angle of ``vector`` (..., 3).
    """
    squared = (vector * vector).sum(-1)[..., None, None]
    small = squared < _SMALL
    # The unused branch of torch.where must stay finite too, or its gradient is NaN.
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    a = torch.where(small, 1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42)), torch.sin(angle) / angle)
    b = torch.where(
        small, (1 - squared / 12 * (1 - squared / 30 * (1 - squared / 56))) / 2, (1 - torch.cos(angle)) / safe
    )
    c = torch.where(
        small,
        (1 - squared / 20 * (1 - squared / 42 * (1 - squared / 72))) / 6,
        (angle - torch.sin(angle)) / (safe * angle),
    )
    return a, b, c


def cross_matrix(vector: Tensor) -> Tensor:
    """Return the (..., 3, 3) matrices [v]ₓ of vectors v (..., 3): [v]ₓ w is the cross product of v and w."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def vector_from_quaternion(quaternion: Tensor) -> Tensor:
    """Return the logarithm of unit quaternions.

    Args:
        quaternion: (..., 4) unit quaternions x, y, z, w of either sign.

    Returns:
        (..., 3) axis times angle in radians, of the shorter way round (angle at most π).
    """
    quaternion = torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
    xyz, w = quaternion[..., :3], quaternion[..., 3:]
    sine = xyz.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, w)
    return xyz * torch.where(sine > 1e-12, angle / sine.clamp_min(1e-12), torch.full_like(sine, 2.0))


def rotation_from_quaternion(quaternion: Tensor) -> Tensor:
    """Return the (..., 3, 3) rotation matrices of unit quaternions (..., 4) in the order x, y, z, w."""
    x, y, z, w = quaternion.unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
            2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
            2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
        ],
        -1,
    ).unflatten(-1, (3, 3))  # fmt: skip


def quaternion_from_rotation(rotation: Tensor) -> Tensor:
    """Return the unit quaternions (..., 4), x, y, z, w with w >= 0, of rotation matrices (..., 3, 3).

    All four classical formulas are evaluated, and the best-conditioned one is used (Shepperd 1978).
    """
    m = rotation.flatten(-2).unbind(-1)
    xx, yy, zz = m[0], m[4], m[8]
    candidates = torch.stack(
        [
            torch.stack([1 + xx - yy - zz, m[1] + m[3], m[2] + m[6], m[7] - m[5]], -1),
            torch.stack([m[1] + m[3], 1 - xx + yy - zz, m[5] + m[7], m[2] - m[6]], -1),
            torch.stack([m[2] + m[6], m[5] + m[7], 1 - xx - yy + zz, m[3] - m[1]], -1),
            torch.stack([m[7] - m[5], m[2] - m[6], m[3] - m[1], 1 + xx + yy + zz], -1),
        ],
        -2,
    )
    best = candidates.diagonal(dim1=-2, dim2=-1).argmax(-1)
    quaternion = torch.take_along_dim(candidates, best[..., None, None], -2).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    return torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def motion_from_twist(twist: Tensor) -> Tensor:
    """Return the exponential of se(3).

    Args:
        twist: (..., 6) translation part ρ, then rotation part ω in radians.

    Returns:
        (..., 4, 4) rigid motions [exp(ω), V(ω) ρ; 0, 1]. Both the value and all derivatives are finite at zero.
    """
    translation, vector = twist[..., :3, None], twist[..., 3:]
    _, b, c = _exponential_coefficients(vector)
    cross = cross_matrix(vector)
    moved = translation + b * (cross @ translation) + c * (cross @ (cross @ translation))
    bottom = torch.zeros_like(twist[..., None, :4])
    bottom[..., 3] = 1
    return torch.cat([torch.cat([rotation_from_vector(vector), moved], -1), bottom], -2)
