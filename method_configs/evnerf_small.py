"""``ns-train evnerf-small``: Ev-NeRF's supervision with the sizes of ``aenerf-small``."""

from __future__ import annotations

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method_configs.eventnerf_small import small_with_windows
from aenerf_ns.method_configs.evnerf import evnerf

evnerf_small = MethodSpecification(
    config=small_with_windows(evnerf.config), description="Ev-NeRF's supervision, small: for a CPU."
)
