"""``ns-train paev3d-small``: PAEv3D's supervision with the sizes of ``aenerf-small``."""

from __future__ import annotations

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method_configs.eventnerf_small import small_with_windows
from aenerf_ns.method_configs.paev3d import paev3d

paev3d_small = MethodSpecification(
    config=small_with_windows(paev3d.config), description="PAEv3D's supervision, small: for a CPU."
)
