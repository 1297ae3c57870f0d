"""``ns-train e2vid-nerf-small``: E2VID + NeRF with the sizes of ``aenerf-small``."""

from __future__ import annotations

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method_configs.aenerf_small import small
from aenerf_ns.method_configs.e2vid_nerf import e2vid_nerf

e2vid_nerf_small = MethodSpecification(config=small(e2vid_nerf.config), description="E2VID + NeRF, small: for a CPU.")
