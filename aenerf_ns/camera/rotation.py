"""Rotations as vectors, matrices and quaternions, in torch, differentiable everywhere including at zero angle.

The exponential maps of roma and Nerfstudio are not smooth to second order at zero, so they are not used.
"""

from __future__ import annotations

import math

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

# Below this squared angle the series are exact to the last bit of float64. Above it the closed forms lose a few bits at
# most.
_SMALL = 1.0
_NUM_TERMS = 9


class TwistExponential(nn.Module):
    """The exponential of se(3), and its rate while the twist moves, in few operations.

    A twist of translation part ρ and rotation part ω is the matrix X = [[ω]ₓ, ρ; 0, 0]. With the angle θ = |ω|,
    exp(X) = I + X + c₂ X² + c₃ X³, where c₂ = (1 − cos θ) / θ² and c₃ = (θ − sin θ) / θ³. The derivatives of c₂ and c₃
    by θ² are c₄ − c₃ / 2 and (3 c₅ − c₄) / 2, where c₄ = (1/2 − c₂) / θ² and c₅ = (1/6 − c₃) / θ². All of them are
    series in θ²: c_k = Σ (−θ²)ʲ / (k + 2j)!, Stumpff's functions.

    All derivatives are finite at zero, too. It is a module so that the constants move to a device once.
    """

    def __init__(self) -> None:
        super().__init__()
        generators = torch.zeros(6, 4, 4, dtype=torch.float64)
        generators[:3, :3, 3] = torch.eye(3)
        axes = torch.eye(3, dtype=torch.float64)
        # The matrices whose product with a vector is the cross product of an axis and the vector.
        generators[3:, :3, :3] = torch.linalg.cross(axes[None], axes[:, None])
        # X with its rate, as [X, Ẋ; 0, X]. From the left, [B, Ḃ] becomes [B X, B Ẋ + Ḃ X]: a product with its rate.
        moving = torch.zeros(12, 8, 8, dtype=torch.float64)
        moving[:6, :4, :4] = moving[:6, 4:, 4:] = moving[6:, :4, 4:] = generators
        terms = torch.tensor(
            [[(-1) ** j / math.factorial(k + 2 * j) for k in range(2, 6)] for j in range(_NUM_TERMS)],
            dtype=torch.float64,
        )
        self._generators: Tensor = nn.Buffer(generators.flatten(1), persistent=False)
        self._moving_generators: Tensor = nn.Buffer(moving.flatten(1), persistent=False)
        self._powers: Tensor = nn.Buffer(torch.arange(1.0, _NUM_TERMS, dtype=torch.float64), persistent=False)
        self._first_terms: Tensor = nn.Buffer(terms[0], persistent=False)
        self._further_terms: Tensor = nn.Buffer(terms[1:], persistent=False)

    def forward(self, base: Tensor, twist: Tensor) -> Tensor:
        """Return base · exp(X).

        Args:
            base: (N, rows, 4) matrices.
            twist: (N, 6) translation part, then rotation part in radians, of the dtype of ``base``.

        Returns:
            (N, rows, 4) matrices.
        """
        once, twice, thrice = _powers_of(base, (twist @ self._generators).unflatten(-1, (4, 4)))
        c2, c3 = self._coefficients(_squared_angle(twist), 2)
        return base + once + c2 * twice + c3 * thrice

    def with_rate(self, base: Tensor, base_rate: Tensor, twist: Tensor, twist_rate: Tensor) -> tuple[Tensor, Tensor]:
        """Return base · exp(X) and its rate.

        Args:
            base: (N, rows, 4) matrices.
            base_rate: (N, rows, 4) their rates.
            twist: (N, 6) see :meth:`forward`.
            twist_rate: (N, 6) its rate.

        Returns:
            Two times (N, rows, 4).
        """
        moving = (torch.cat([twist, twist_rate], -1) @ self._moving_generators).unflatten(-1, (8, 8))
        start = torch.cat([base, base_rate], -1)
        once, twice, thrice = _powers_of(start, moving)
        c2, c3, c4, c5 = self._coefficients(_squared_angle(twist), 4)
        value, rate = (start + once + c2 * twice + c3 * thrice).chunk(2, -1)
        # Half of the rate of θ².
        half = (twist[:, 3:] * twist_rate[:, 3:]).sum(-1)[:, None, None]
        rate_of_c2, rate_of_c3 = (2 * c4 - c3) * half, (3 * c5 - c4) * half
        return value, rate + rate_of_c2 * twice[..., :4] + rate_of_c3 * thrice[..., :4]

    def _coefficients(self, squared: Tensor, count: int) -> tuple[Tensor, ...]:
        """Return c₂ and c₃, and with a ``count`` of 4 also c₄ and c₅, each (N, 1, 1), of (N, 1) squared angles."""
        near = torch.addmm(self._first_terms[:count], squared**self._powers, self._further_terms[:, :count])
        small = squared < _SMALL
        # The unused branch of torch.where must stay finite too, or its gradient is NaN.
        safe = torch.where(small, _SMALL, squared)
        angle = safe.sqrt()
        far = torch.cat([1 - torch.cos(angle), 1 - torch.sin(angle) / angle], -1) / safe
        if count == 4:
            far = torch.cat([far, (self._first_terms[:2] - far) / safe], -1)
        return torch.where(small, near, far)[..., None, None].unbind(1)


def _squared_angle(twist: Tensor) -> Tensor:
    """Return the (N, 1) squared angles of twists (N, 6)."""
    return twist[:, 3:].square().sum(-1, keepdim=True)


def _powers_of(start: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return start · matrix, start · matrix² and start · matrix³."""
    once = start @ matrix
    twice = once @ matrix
    return once, twice, twice @ matrix


def motion_from_twist(twist: Tensor) -> Tensor:
    """Return the exponential of se(3).

    Args:
        twist: (..., 6) translation part ρ, then rotation part ω in radians.

    Returns:
        (..., 4, 4) rigid motions [exp(ω), V(ω) ρ; 0, 1]. Both the value and all derivatives are finite at zero.
    """
    flat = twist.reshape(-1, 6)
    identity = torch.eye(4, dtype=twist.dtype, device=twist.device).expand(len(flat), 4, 4)
    return TwistExponential().to(twist)(identity, flat).reshape(*twist.shape[:-1], 4, 4)


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Return the (..., 3, 3) rotations by axes times angles in radians (..., 3), with finite derivatives at zero."""
    return motion_from_twist(nn.functional.pad(vector, (3, 0)))[..., :3, :3]


def rotation_from_quaternion(quaternion: Tensor) -> Tensor:
    """Return the (N, 3, 3) rotation matrices of quaternions (N, 4) in the order x, y, z, w. It has no gradient."""
    return torch.from_numpy(Rotation.from_quat(quaternion.cpu().numpy()).as_matrix()).to(quaternion)


def quaternion_from_rotation(rotation: Tensor) -> Tensor:
    """Return the unit quaternions (N, 4), x, y, z, w with w >= 0, of rotation matrices (N, 3, 3). No gradient."""
    return torch.from_numpy(Rotation.from_matrix(rotation.cpu().numpy()).as_quat(canonical=True)).to(rotation)
