"""From log-radiance, which events determine up to an affine map, to a picture."""

from __future__ import annotations

import torch
from torch import Tensor, nn

# Added to radiance in [0, 1] before the logarithm, so that black reference pixels are finite.
_EPSILON = 1e-3
# Without reference images: the share of pixels that may clip at either end, and the radiance the ends are mapped to.
_CLIPPED = 0.01
_DARK, _BRIGHT = 0.02, 0.9


class AffineColorCorrection(nn.Module):
    """Per-channel affine map of log-radiance (paper, "Color Correction of Synthesized Views"), kept in checkpoints.

    Args:
        num_channels: radiance channels, 1 or 3.
    """

    scale: Tensor
    offset: Tensor
    num_views: Tensor

    def __init__(self, num_channels: int) -> None:
        super().__init__()
        self.register_buffer("scale", torch.ones(num_channels))
        self.register_buffer("offset", torch.zeros(num_channels))
        # Reference views the map was fitted on; 0 for the percentile stretch.
        self.register_buffer("num_views", torch.zeros((), dtype=torch.int64))

    def forward(self, log_radiance: Tensor) -> Tensor:
        """Linear radiance (..., channels), of reference scale, of rendered log-radiance (..., channels)."""
        return torch.exp(self.scale * log_radiance + self.offset) - _EPSILON

    def fit(self, log_radiance: Tensor, reference: Tensor, num_views: int) -> None:
        """Least squares of log(reference + ε) against log-radiance, per channel, in float64.

        Args:
            log_radiance: (N, channels) rendered.
            reference: (N, channels) linear radiance in [0, 1] of the same pixels.
            num_views: number of reference views these pixels are from.
        """
        x, y = log_radiance.double(), torch.log(reference.double() + _EPSILON)
        x_mean, y_mean = x.mean(0), y.mean(0)
        # A constant rendering, as before training, has no slope: the offset alone is fitted.
        scale = ((x - x_mean) * (y - y_mean)).sum(0) / (x - x_mean).square().sum(0).clamp_min(1e-12)
        self.scale.copy_(scale)
        self.offset.copy_(y_mean - scale * x_mean)
        self.num_views.fill_(num_views)

    def stretch(self, log_radiance: Tensor) -> None:
        """Without reference images: maps the 1st and 99th percentile over all channels to dark and bright.

        Args:
            log_radiance: (N, channels) rendered.
        """
        low, high = torch.quantile(
            log_radiance.double().flatten(), log_radiance.new_tensor([_CLIPPED, 1 - _CLIPPED]).double()
        )
        ends = torch.log(low.new_tensor([_DARK, _BRIGHT]) + _EPSILON)
        scale = (ends[1] - ends[0]) / (high - low).clamp_min(1e-6)
        self.scale.fill_(scale)
        self.offset.fill_(ends[0] - scale * low)
        self.num_views.zero_()
