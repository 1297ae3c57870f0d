"""``ns-train paev3d``: the supervision of PAEv3D, for a GPU."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.method_configs.aenerf import aenerf
from aenerf_ns.supervision.paev3d import PAEv3DSupervisionConfig, PatchSamplerConfig

_base = deepcopy(aenerf.config)

paev3d = MethodSpecification(
    config=replace(
        _base,
        method_name="paev3d",
        pipeline=replace(
            _base.pipeline,
            datamanager=replace(_base.pipeline.datamanager, sampler=PatchSamplerConfig()),
            model=replace(
                _base.pipeline.model,
                supervision=PAEv3DSupervisionConfig(),
                loss_coefficients={
                    "reconstruction_loss": 1.0,
                    "mask_loss": 1e-3,
                    "flow_loss": 1e-2,
                    "depth_loss": 1e-3,
                    "interlevel_loss": 2.5e-3,
                    "distortion_loss": 1e-3,
                },
                camera_optimizer=PoseCorrectionConfig(mode="off"),
            ),
        ),
    ),
    description="PAEv3D's supervision: patches in windows, with priors from optical flow, on the poses as given.",
)
