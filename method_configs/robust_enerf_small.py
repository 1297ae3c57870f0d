"""``ns-train robust-enerf-small``: Robust e-NeRF's supervision with the sizes of ``aenerf-small``."""

from __future__ import annotations

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method_configs.aenerf_small import small
from aenerf_ns.method_configs.robust_enerf import robust_enerf

robust_enerf_small = MethodSpecification(
    config=small(robust_enerf.config), description="Robust e-NeRF's supervision, small: for a CPU."
)
