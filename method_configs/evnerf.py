"""``ns-train evnerf``: the supervision of Ev-NeRF (Hwang et al., WACV 2023), for a GPU."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.method_configs.aenerf import aenerf
from aenerf_ns.supervision.peers.windows import EvNeRFSupervisionConfig, WindowSamplerConfig

_base = deepcopy(aenerf.config)

evnerf = MethodSpecification(
    config=replace(
        _base,
        method_name="evnerf",
        pipeline=replace(
            _base.pipeline,
            datamanager=replace(
                _base.pipeline.datamanager,
                sampler=WindowSamplerConfig(shortest_window=0.02, longest_window=0.02, share_of_all_pixels=1.0),
            ),
            model=replace(
                _base.pipeline.model,
                supervision=EvNeRFSupervisionConfig(),
                loss_coefficients={
                    "reconstruction_loss": 1.0,
                    "threshold_bound_loss": 1000.0,
                    "interlevel_loss": 2.5e-3,
                    "distortion_loss": 1e-3,
                },
                camera_optimizer=PoseCorrectionConfig(mode="off"),
            ),
        ),
    ),
    description="Ev-NeRF's supervision: slices of events, a dead zone and learned thresholds, on the poses as given.",
)
