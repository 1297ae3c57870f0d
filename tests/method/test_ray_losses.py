"""The distortion loss in linear time, beside the framework's."""

import pytest
import torch
from helpers.small_models import make_rays
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.model_components.losses import distortion_loss as framework_distortion_loss
from nerfstudio.model_components.ray_samplers import UniformLinDispPiecewiseSampler

from aenerf_ns.method.ray_losses import distortion_loss


@pytest.fixture
def samples() -> RaySamples:
    rays = make_rays(15)
    rays.nears, rays.fars = torch.full((15, 1), 0.05), torch.full((15, 1), 100.0)
    return UniformLinDispPiecewiseSampler(num_samples=48).train()(rays)


@pytest.mark.parametrize("opaque", [False, True])
def test_value_and_gradient_are_those_of_the_framework(samples: RaySamples, opaque: bool) -> None:
    density = torch.rand(15, 48, 1, generator=torch.Generator().manual_seed(1)) * (100 if opaque else 1)
    results = []
    for loss in (distortion_loss, lambda weights, samples: framework_distortion_loss([weights], [samples])):
        leaf = density.clone().requires_grad_()
        value = loss(samples.get_weights(leaf), samples)
        value.backward()
        results.append((value.detach(), leaf.grad))
    assert results[0][0] > 1e-3
    for own, framework in zip(*results, strict=True):
        torch.testing.assert_close(own, framework, rtol=1e-4, atol=1e-7)
