"""``ns-train evnerf-small``: Ev-NeRF's supervision with the sizes of ``aenerf-small``."""

from __future__ import annotations

from dataclasses import replace

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method_configs.aenerf_small import small
from aenerf_ns.method_configs.evnerf import evnerf

_base = small(evnerf.config)
_data = _base.pipeline.datamanager

evnerf_small = MethodSpecification(
    config=replace(
        _base,
        pipeline=replace(
            _base.pipeline,
            # As many windows in a batch as at full size.
            datamanager=replace(_data, sampler=replace(_data.sampler, pixels_per_window=128)),
        ),
    ),
    description="Ev-NeRF's supervision, small: for a CPU.",
)
