"""The framework's samplers of the points along a ray, without a copy from the CPU, and with a state to keep."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.model_components.ray_samplers import (
    ProposalNetworkSampler,
    SpacedSampler,
    UniformLinDispPiecewiseSampler,
    UniformSampler,
)


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


class ProposalSampler(ProposalNetworkSampler):
    """Nerfstudio's proposal sampler, which pictures do not disturb, and which a resumed training can set."""

    def generate_ray_samples(
        self, ray_bundle: RayBundle | None = None, density_fns: list[Callable] | None = None
    ) -> tuple[RaySamples, list, list]:
        """Return samples of the field, and weights and samples of each round of proposals."""
        steps_since_update: int = self._steps_since_update  # type: ignore[has-type]
        found = super().generate_ray_samples(ray_bundle, density_fns)
        if not self.training:
            # A picture must not move the steps that train the proposal networks.
            self._steps_since_update = steps_since_update
        return found

    def schedule_state(self) -> dict[str, int]:
        """Return the steps so far, and those since the proposal networks were last trained."""
        return {"step": self._step, "steps_since_update": self._steps_since_update}

    def load_schedule_state(self, state: dict[str, int]) -> None:
        """Set what :meth:`schedule_state` returned."""
        self._step, self._steps_since_update = state["step"], state["steps_since_update"]
