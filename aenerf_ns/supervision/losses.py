"""The losses on rendered log-radiance. Those on the ray weights are the framework's."""

from __future__ import annotations

import torch
from torch import Tensor


def log_radiance_change(
    num_positive: Tensor, num_negative: Tensor, positive_threshold: Tensor | float, negative_threshold: float
) -> Tensor:
    """Change of log-radiance that a pair of events tells of: Δ = n+ C+ − n− C− (paper, eq. 5).

    Args:
        num_positive: (N,) positive events after the earlier time up to the later one.
        num_negative: (N,) negative events, likewise.
        positive_threshold: C+; a scalar in the graph when it is learned.
        negative_threshold: C−.

    Returns:
        (N,) changes.
    """
    return num_positive * positive_threshold - num_negative * negative_threshold


def silent_change(
    predicted: Tensor, change: Tensor, positive_threshold: Tensor | float, negative_threshold: float
) -> Tensor:
    """The change nearest to the predicted one after which a pixel is still silent: within a threshold of its events'.

    Args:
        predicted: (N,) rendered changes of log-radiance up to a moment between two events.
        change: (N,) changes that the events tell of up to the last one before it.
        positive_threshold: C+.
        negative_threshold: C−.

    Returns:
        (N,) changes between change − C− and change + C+, constants.
    """
    return torch.minimum(torch.maximum(predicted, change - negative_threshold), change + positive_threshold).detach()


def temporal_loss(rate: Tensor, change: Tensor, interval: Tensor) -> Tensor:
    """ℓ_g (paper, eq. 12): the mean relative error |(G_gt − G_pred) / G_gt|, with G_gt = change / interval.

    Written so that no interval, however short, overflows. Pairs whose merged events cancel have no G_gt to be
    relative to, and are left out.

    Args:
        rate: (N,) G_pred, rendered rates of log-radiance per second.
        change: (N,) changes that the events tell of.
        interval: (N,) seconds.

    Returns:
        The loss, a scalar: 1 for a constant field.
    """
    usable = change != 0
    relative = 1 - rate * interval / torch.where(usable, change, torch.ones_like(change))
    return (relative.abs() * usable).sum() / usable.sum().clamp_min(1)


def reconstruction_loss(predicted: Tensor, target: Tensor, mean_contrast_threshold: Tensor | float) -> Tensor:
    """ℓ_r (paper, eq. 11): the mean squared error of log-radiance changes, in units of the mean contrast threshold.

    Args:
        predicted: (N,) rendered changes of log-radiance.
        target: (N,) changes that the events tell of.
        mean_contrast_threshold: C̄.

    Returns:
        The loss, a scalar: 1 for a constant field when every pair is one event and C+ = C−.
    """
    return (predicted - target).square().mean() / mean_contrast_threshold**2
