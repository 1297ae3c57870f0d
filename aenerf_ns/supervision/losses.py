"""The losses on rendered log-radiance. The losses on ray weights stand with the model."""

from __future__ import annotations

import torch
from torch import Tensor


def temporal_loss(rate: Tensor, change: Tensor, interval: Tensor) -> Tensor:
    """Return ℓ_g (paper, eq. 12): the mean relative error |(G_gt − G_pred) / G_gt|, with G_gt = change / interval.

    The change is divided by last, so that no interval overflows, however short. Pairs whose events cancel are left out,
    because their G_gt is zero.

    Args:
        rate: (N,) G_pred, rendered rates of log-radiance per second.
        change: (N,) changes that the events tell of.
        interval: (N,) seconds.

    Returns:
        The loss, a scalar: 1 for a constant field.
    """
    # Events that cancel may leave a rounding error in place of zero. It is far smaller than a contrast threshold.
    usable = change.abs() > 1e-5
    relative = 1 - rate * interval / torch.where(usable, change, 1)
    return (relative.abs() * usable).sum() / usable.sum().clamp_min(1)


def reconstruction_loss(
    predicted: Tensor, target: Tensor, mean_contrast_threshold: Tensor | float, weight: Tensor | float = 1.0
) -> Tensor:
    """Return ℓ_r (paper, eq. 11): the mean squared error of changes, in units of the mean contrast threshold.

    Args:
        predicted: (N,) rendered changes of log-radiance.
        target: (N,) changes that the events tell of.
        mean_contrast_threshold: C̄.
        weight: (N,) how much each counts.

    Returns:
        The loss, a scalar: 1 for a constant field when all weights are 1, every pair is one event and C+ = C−.
    """
    return (weight * (predicted - target).square()).mean() / mean_contrast_threshold**2
