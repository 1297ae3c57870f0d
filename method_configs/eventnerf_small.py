"""``ns-train eventnerf-small``: EventNeRF's supervision with the sizes of ``aenerf-small``."""

from __future__ import annotations

from dataclasses import replace

from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method_configs.aenerf_small import small
from aenerf_ns.method_configs.eventnerf import eventnerf


def small_with_windows(config: TrainerConfig) -> TrainerConfig:
    """Return a method that draws windows with the sizes of ``aenerf-small``."""
    base = small(config)
    data = base.pipeline.datamanager
    # As many windows in a batch as at full size.
    sampler = replace(data.sampler, pixels_per_window=128)
    return replace(base, pipeline=replace(base.pipeline, datamanager=replace(data, sampler=sampler)))


eventnerf_small = MethodSpecification(
    config=small_with_windows(eventnerf.config), description="EventNeRF's supervision, small: for a CPU."
)
