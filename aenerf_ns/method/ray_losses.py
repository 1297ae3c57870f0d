"""The loss on the weights along a ray. The interlevel loss is the framework's."""

from __future__ import annotations

from nerfstudio.cameras.rays import RaySamples
from nerfstudio.model_components.losses import ray_samples_to_sdist
from torch import Tensor


def distortion_loss(weights: Tensor, samples: RaySamples) -> Tensor:
    """Return the distortion loss (paper, eq. 13; Mip-NeRF 360, eq. 15), the mean over rays, as the framework does.

    The framework compares every sample of a ray with every other one. Running sums give the same value in linear time,
    because the samples are ordered: the sum of w_i w_j |m_i - m_j| is twice that of w_i w_j (m_i - m_j) over j < i.

    Args:
        weights: (N, samples, 1).
        samples: (N, samples), ordered along the rays.
    """
    ends, weights = ray_samples_to_sdist(samples), weights[..., 0]
    middles, lengths = (ends[..., 1:] + ends[..., :-1]) / 2, ends[..., 1:] - ends[..., :-1]
    moments = weights * middles
    between = 2 * (moments * weights.cumsum(-1) - weights * moments.cumsum(-1)).sum(-1)
    within = (weights.square() * lengths).sum(-1) / 3
    return (between + within).mean()
