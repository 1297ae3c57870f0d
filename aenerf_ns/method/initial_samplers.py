"""The framework's samplers for the first samples along a ray, without its copy from the CPU."""

from __future__ import annotations

from contextlib import nullcontext

from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.model_components.ray_samplers import SpacedSampler, UniformLinDispPiecewiseSampler, UniformSampler


class _OnDevice(SpacedSampler):
    """Make the bins on the rays' device. The framework makes them on the CPU, and the copy waits for the GPU."""

    def generate_ray_samples(self, ray_bundle: RayBundle | None = None, num_samples: int | None = None) -> RaySamples:
        """Return samples along rays that have ``nears`` and ``fars``."""
        assert ray_bundle is not None
        device = ray_bundle.origins.device
        # Torch is slower as long as a device is set, and the CPU is set already.
        with nullcontext() if device.type == "cpu" else device:
            return super().generate_ray_samples(ray_bundle, num_samples)


class EvenSampler(_OnDevice, UniformSampler):
    """Spread samples evenly."""


class EvenThenDisparitySampler(_OnDevice, UniformLinDispPiecewiseSampler):
    """Spread samples evenly up to a distance of 1, and then evenly in disparity."""
