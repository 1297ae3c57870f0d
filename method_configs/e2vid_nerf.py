"""``ns-train e2vid-nerf``: E2VID + NeRF, a field trained on images reconstructed from the events, for a GPU."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.method_configs.aenerf import aenerf
from aenerf_ns.supervision.peers.frames import FrameSamplerConfig, FrameSupervisionConfig

_base = deepcopy(aenerf.config)

e2vid_nerf = MethodSpecification(
    config=replace(
        _base,
        method_name="e2vid-nerf",
        pipeline=replace(
            _base.pipeline,
            datamanager=replace(_base.pipeline.datamanager, sampler=FrameSamplerConfig()),
            model=replace(
                _base.pipeline.model,
                supervision=FrameSupervisionConfig(),
                loss_coefficients={"reconstruction_loss": 1.0, "interlevel_loss": 2.5e-3, "distortion_loss": 1e-3},
                camera_optimizer=PoseCorrectionConfig(mode="off"),
            ),
        ),
    ),
    description="E2VID + NeRF: trains on the images of aenerf reconstruct, on the poses as given.",
)
