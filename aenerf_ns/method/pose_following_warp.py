"""Space that moves along with the corrections of the poses."""

from __future__ import annotations

import math

import torch
import torch.autograd.forward_ad as forward_ad
import torch.nn.functional as F
from nerfstudio.field_components.spatial_distortions import SpatialDistortion
from torch import Tensor, nn

from aenerf_ns.method.field import to_unit_cube
from aenerf_ns.method.pose_correction import PoseCorrection

# Cells along an axis of the unit cube of the scene. The times that see a place change little from cell to cell.
_RESOLUTION = 24
# The most times at which twists are taken: it bounds memory and time of a step on long recordings.
_MAX_TIMES = 256
# Neighbourhoods that the weights are averaged over, and the weight of each against the next smaller one.
_NUM_BLURS, _BLUR_WEIGHT = 4, 0.05


class PoseFollowingWarp(nn.Module):
    """Carry the field along with the corrections of the poses.

    If a correction moves the cameras of some time, the places that only they see seem to move with them. A field that
    is fixed in the world must then unlearn the places and learn them again, so it holds the cameras where they are, and
    corrections creep. Here the field is fixed in a space that moves along instead: place p is looked up at

        D(p) = p − v(p) − ω(p) × p,

    where (v, ω) is the mean of the corrections' twists in the world, over the times that see p. A correction that all
    these times share moves the place with the cameras, and changes no rendering. Only differences between the
    corrections of these times are left to be learned, and that is what events tell of. D is smooth, and it is the
    identity where poses are not corrected.

    Times see a place as often as training rays of these times end there, by their rendering weights. The rays are
    counted in the cells of a coarse grid, by :meth:`accumulate`.

    Twists and weights are differentiated, the place at which they are looked up is not: within the span of a gradient,
    neighbors move alike.

    Args:
        correction: of the poses; it learns something.
        spatial_distortion: contraction of space, or None for a bounded scene.
        aabb: (2, 3) box of the fields.

    Attributes:
        accumulating: whether rays are being counted. The model switches it.
    """

    def __init__(self, correction: PoseCorrection, spatial_distortion: SpatialDistortion | None, aabb: Tensor) -> None:
        super().__init__()
        self._spatial_distortion = spatial_distortion
        self._aabb: Tensor = nn.Buffer(aabb, persistent=False)
        self.accumulating = False
        duration = correction.trajectory.duration
        count = min(math.ceil(duration / correction.config.knot_interval) + 1, _MAX_TIMES)
        self._interval = duration / (count - 1)
        seconds = torch.linspace(0, duration, count, dtype=torch.float64)
        self._seconds: Tensor = nn.Buffer(seconds, persistent=False)
        base = correction.trajectory.pose(correction.on_clock_of_poses(seconds, at_first=True))
        self._base_poses: Tensor = nn.Buffer(base, persistent=False)
        self._seen: Tensor = nn.Buffer(torch.zeros(_RESOLUTION**3, count))
        self._weights: Tensor = nn.Buffer(torch.full((_RESOLUTION**3, count), 1 / count))
        self._strides: Tensor = nn.Buffer(torch.tensor([_RESOLUTION**2, _RESOLUTION, 1]), persistent=False)
        self._twists: Tensor | None = None

    def update(self, correction: PoseCorrection) -> None:
        """Take the corrections as they are now, for all positions until the next call."""
        twists = correction.world_twists(self._seconds, self._base_poses).to(self._weights)
        # Half precision would round the places to a thousandth of the twists' size.
        with torch.autocast(twists.device.type, enabled=False):
            self._twists = (self._weights @ twists).unflatten(0, [_RESOLUTION] * 3)

    def forward(self, positions: Tensor, detached: bool = False) -> Tensor:
        """Return the places (..., 3) in the field's space of positions (..., 3) in the scene.

        Gradients reach the positions, and the motion unless it is ``detached``.
        """
        assert self._twists is not None
        grid = self._twists.detach() if detached else self._twists
        with torch.no_grad():
            unit = self._to_unit(forward_ad.unpack_dual(positions).primal.flatten(0, -2)).to(grid.dtype)
        # torch counts the coordinates of a place from the last axis.
        places = (2 * unit - 1).flip(-1)[None, None, None]
        cells = grid.permute(3, 0, 1, 2)[None]
        twists = F.grid_sample(cells, places, padding_mode="border", align_corners=False)[0, :, 0, 0].T
        translation, rotation = twists.unflatten(0, positions.shape[:-1]).split(3, -1)
        return positions - translation - torch.linalg.cross(rotation, positions)

    def _to_unit(self, positions: Tensor) -> Tensor:
        return to_unit_cube(positions, self._spatial_distortion, self._aabb)

    @torch.no_grad()
    def accumulate(self, positions: Tensor, weights: Tensor, seconds: Tensor) -> None:
        """Count rays.

        Args:
            positions: (N, samples, 3) of the samples in the scene.
            weights: (N, samples) rendering weights.
            seconds: (N,) times of the rays since the trajectory's start.
        """
        unit = self._to_unit(positions.flatten(0, -2)).unflatten(0, positions.shape[:-1])
        inside = ((unit > 0) & (unit < 1)).all(-1)
        cell = ((unit * _RESOLUTION).long().clamp(0, _RESOLUTION - 1) * self._strides).sum(-1)
        place = seconds / self._interval
        before = place.long().clamp(0, len(self._seconds) - 2)
        share = (place - before).to(weights)[:, None]
        index = cell * len(self._seconds) + before[:, None]
        counts = (weights * inside).to(self._seen)
        seen = self._seen.view(-1)
        seen.index_add_(0, index.flatten(), (counts * (1 - share)).flatten())
        seen.index_add_(0, (index + 1).flatten(), (counts * share).flatten())

    @torch.no_grad()
    def update_weights(self) -> None:
        """Set the weights of the times in each cell by the rays that have been counted in its neighbourhood.

        Where no ray has ended near a cell, all rays count.
        """
        around = self._seen.T.unflatten(1, [_RESOLUTION] * 3)[:, None]
        total, scale = torch.zeros_like(around), 1.0
        for _ in range(_NUM_BLURS):
            around = F.avg_pool3d(F.pad(around, [1] * 6, mode="replicate"), 3, 1)
            total += scale * around
            scale *= _BLUR_WEIGHT
        everywhere = self._seen.mean(0) * 1e-6 + torch.finfo(total.dtype).tiny
        total = total.flatten(1).T + everywhere
        self._weights.copy_(total / total.sum(-1, keepdim=True))
