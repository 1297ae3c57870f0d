"""The losses on rendered log-radiance. The losses on ray weights stand with the model."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def log_radiance_change(
    num_positive: Tensor, num_negative: Tensor, positive_threshold: Tensor | float, negative_threshold: Tensor | float
) -> Tensor:
    """Return the change of log-radiance that events of a pixel tell of: Δ = n+ C+ − n− C− (paper, eq. 5).

    Args:
        num_positive: (N,) positive events after the earlier time up to the later one.
        num_negative: (N,) negative events in the same time.
        positive_threshold: C+; a scalar in the graph when it is learned.
        negative_threshold: C−; a scalar in the graph when it is learned.

    Returns:
        (N,) changes.
    """
    return num_positive * positive_threshold - num_negative * negative_threshold


def silent_change(
    predicted: Tensor, change: Tensor, positive_threshold: Tensor | float, negative_threshold: float
) -> Tensor:
    """Return the change nearest to the predicted one that leaves a pixel silent.

    A pixel is silent as long as its log-radiance is within a threshold of the value at its last event.

    Args:
        predicted: (N,) rendered changes of log-radiance up to a moment between two events.
        change: (N,) changes that the events tell of, up to the last event before that moment.
        positive_threshold: C+.
        negative_threshold: C−.

    Returns:
        (N,) changes between change − C− and change + C+, constants.
    """
    return torch.minimum(torch.maximum(predicted, change - negative_threshold), change + positive_threshold).detach()


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
    usable = change != 0
    relative = 1 - rate * interval / torch.where(usable, change, torch.ones_like(change))
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


def dead_zone_excess(
    predicted: Tensor, change: Tensor, positive_threshold: Tensor, negative_threshold: Tensor
) -> Tensor:
    """Return by how much rendered changes leave Ev-NeRF's dead zone.

    A change that differs from the events' by less than a threshold triggers no event. Other than
    :func:`silent_change`, this has gradients for the thresholds, as the edges of the zone.

    Args:
        predicted: (N,) rendered changes of log-radiance.
        change: (N,) changes that the events tell of.
        positive_threshold: B+, a scalar.
        negative_threshold: B−, a scalar, positive too.

    Returns:
        (N,) max(0, e − B+) + max(0, −B− − e) for e = predicted − change.
    """
    error = predicted - change
    return F.relu(error - positive_threshold) + F.relu(-negative_threshold - error)
