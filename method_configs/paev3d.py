"""``ns-train paev3d``: the supervision of PAEv3D (Wang et al., ICRA 2024), for a GPU."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method_configs.eventnerf import eventnerf
from aenerf_ns.supervision.peers.paev3d import FlowPatchSamplerConfig, PAEv3DSupervisionConfig

_base = deepcopy(eventnerf.config)

paev3d = MethodSpecification(
    config=replace(
        _base,
        method_name="paev3d",
        pipeline=replace(
            _base.pipeline,
            datamanager=replace(_base.pipeline.datamanager, sampler=FlowPatchSamplerConfig()),
            model=replace(
                _base.pipeline.model,
                supervision=PAEv3DSupervisionConfig(),
                loss_coefficients={
                    **_base.pipeline.model.loss_coefficients,
                    "mask_loss": 1e-3,
                    "flow_loss": 1e-2,
                    "depth_loss": 1e-3,
                },
            ),
        ),
    ),
    description="PAEv3D's supervision: patches in windows, with priors from optical flow, on the poses as given.",
)
