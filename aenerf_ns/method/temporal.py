"""The derivative of rendered log-radiance along the camera's motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
import torch.autograd.forward_ad as forward_ad
from nerfstudio.cameras.rays import RaySamples
from torch import Tensor


def log_radiance_rate(
    render: Callable[[RaySamples], tuple[Tensor, Tensor]],
    samples: RaySamples,
    rays: tuple[Tensor, Tensor],
    ray_rates: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return G_pred of the paper (before eq. 12): the total derivative d log L̂ / dt while the rays move.

    Forward-mode automatic differentiation goes through the field and the compositing. The derivative is exact, but for
    a field that moves along: the place at which it looks up its motion is held constant. One ordinary backward pass
    then reaches the parameters of the field and of the rays' motion. The samples' distances along the ray are held
    constant. Everything is in full precision even under autocast, because on a fine grid rates per second exceed the
    range of half precision.

    Args:
        render: returns log-radiance (N, channels) and weights (N, samples, 1) for ray samples.
        samples: samples along the N rays.
        rays: origins and directions (N, 3).
        ray_rates: their derivatives with respect to time (N, 3), per second.

    Returns:
        Log-radiance (N, channels), its rate (N, channels) per second, and the weights.
    """
    with torch.autocast(rays[0].device.type, enabled=False), forward_ad.dual_level():
        origins, directions = (
            # Cloned, because the tangent of a part of a tensor would get memory for the whole.
            forward_ad.make_dual(value.clone(), rate)[:, None].expand_as(samples.frustums.origins)
            for value, rate in zip(rays, ray_rates, strict=True)
        )
        moving = replace(samples, frustums=replace(samples.frustums, origins=origins, directions=directions))
        log_radiance, weights = render(moving)
        primal, rate = forward_ad.unpack_dual(log_radiance)
        return primal, rate, forward_ad.unpack_dual(weights).primal
