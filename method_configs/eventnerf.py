"""``ns-train eventnerf``: the supervision of EventNeRF (Rudnev et al., CVPR 2023), for a GPU."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.method_configs.aenerf import aenerf
from aenerf_ns.supervision.peers.windows import EventNeRFSupervisionConfig, WindowSamplerConfig

_base = deepcopy(aenerf.config)

eventnerf = MethodSpecification(
    config=replace(
        _base,
        method_name="eventnerf",
        pipeline=replace(
            _base.pipeline,
            datamanager=replace(_base.pipeline.datamanager, sampler=WindowSamplerConfig()),
            model=replace(
                _base.pipeline.model,
                supervision=EventNeRFSupervisionConfig(),
                loss_coefficients={"reconstruction_loss": 1.0, "interlevel_loss": 2.5e-3, "distortion_loss": 1e-3},
                camera_optimizer=PoseCorrectionConfig(mode="off"),
            ),
        ),
    ),
    description="EventNeRF's supervision: events summed over windows of random length, on the poses as given.",
)
