"""The losses on rendered log-radiance. Those on the ray weights are the framework's."""

from __future__ import annotations

from torch import Tensor


def log_radiance_change(
    num_positive: Tensor, num_negative: Tensor, positive_threshold: float, negative_threshold: float
) -> Tensor:
    """Change of log-radiance that a pair of events tells of: Δ = n+ C+ − n− C− (paper, eq. 5).

    Args:
        num_positive: (N,) positive events at the later time, one but for merged events.
        num_negative: (N,) negative events at the later time.
        positive_threshold: C+.
        negative_threshold: C−.

    Returns:
        (N,) changes.
    """
    return num_positive * positive_threshold - num_negative * negative_threshold


def reconstruction_loss(predicted: Tensor, target: Tensor, mean_contrast_threshold: float) -> Tensor:
    """ℓ_r (paper, eq. 11): the mean squared error of log-radiance changes, in units of the mean contrast threshold.

    Args:
        predicted: (N,) rendered changes of log-radiance.
        target: (N,) changes that the events tell of.
        mean_contrast_threshold: C̄.

    Returns:
        The loss, a scalar: 1 for a constant field when every pair is one event and C+ = C−.
    """
    return (predicted - target).square().mean() / mean_contrast_threshold**2
