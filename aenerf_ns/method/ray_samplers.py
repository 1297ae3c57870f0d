"""The framework's sampler of the points along a ray, without a copy from the CPU, and with a state to keep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext

import torch
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler
from torch import Tensor


class ProposalSampler(ProposalNetworkSampler):
    """Nerfstudio's proposal sampler, which pictures do not disturb, and which a resumed training can set.

    The density functions are given samples, where the framework gives them positions alone: an integrated encoding
    needs the part of space that a sample stands for.
    """

    _steps_since_update: int

    def generate_ray_samples(
        self,
        ray_bundle: RayBundle,
        density_fns: Sequence[Callable[[RaySamples], tuple[Tensor, Tensor | None]]],
    ) -> tuple[RaySamples, list[Tensor], list[RaySamples]]:
        """Return samples of the field, and weights and samples of each round of proposals."""
        weights_list: list[Tensor] = []
        samples_list: list[RaySamples] = []
        # As in the framework: the proposal networks are trained at every step at first, and then at some.
        updated = self._steps_since_update > self.update_sched(self._step) or self._step < 10
        first, *others = self.num_proposal_samples_per_ray
        device = ray_bundle.origins.device
        # The framework makes the bins on the default device, and a copy from the CPU waits for the GPU. Torch is slower
        # as long as a device is set, and the CPU is set already.
        with nullcontext() if device.type == "cpu" else device:
            samples = self.initial_sampler(ray_bundle, num_samples=first)
        for density_fn, count in zip(density_fns, (*others, self.num_nerf_samples_per_ray), strict=True):
            with torch.set_grad_enabled(updated and torch.is_grad_enabled()):
                weights = samples.get_weights(density_fn(samples)[0])
            weights_list.append(weights)
            samples_list.append(samples)
            samples = self.pdf_sampler(ray_bundle, samples, weights**self._anneal, num_samples=count)
        # A picture must not move the steps that train the proposal networks.
        if updated and self.training:
            self._steps_since_update = 0
        return samples, weights_list, samples_list

    def schedule_state(self) -> dict[str, int]:
        """Return the steps so far, and those since the proposal networks were last trained."""
        return {"step": self._step, "steps_since_update": self._steps_since_update}

    def load_schedule_state(self, state: dict[str, int]) -> None:
        """Set what :meth:`schedule_state` returned."""
        self._step, self._steps_since_update = state["step"], state["steps_since_update"]
