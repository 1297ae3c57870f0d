"""``ns-train robust-enerf``: the supervision of Robust e-NeRF (Low and Lee, ICCV 2023), for a GPU."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.method_configs.aenerf import aenerf
from aenerf_ns.supervision.event_pairs import PairSamplerConfig

_base = deepcopy(aenerf.config)

robust_enerf = MethodSpecification(
    config=replace(
        _base,
        method_name="robust-enerf",
        pipeline=replace(
            _base.pipeline,
            datamanager=replace(
                _base.pipeline.datamanager, sampler=PairSamplerConfig(max_events_per_pair=1, share_to_moments=0.0)
            ),
            model=replace(_base.pipeline.model, camera_optimizer=PoseCorrectionConfig(mode="off")),
        ),
    ),
    description="Robust e-NeRF's supervision: pairs of consecutive events, on the poses as given.",
)
