"""``ns-train aenerf-small``: the same method, small enough to train in minutes on a laptop's CPU."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method.networks import FieldConfig, ProposalConfig
from aenerf_ns.method_configs.aenerf import aenerf


def small(config: TrainerConfig) -> TrainerConfig:
    """Return a method with fewer steps, fewer rays and smaller networks. Its name ends with "-small"."""
    base = deepcopy(config)
    return replace(
        base,
        method_name=f"{base.method_name}-small",
        max_num_iterations=2000,
        steps_per_save=1000,
        pipeline=replace(
            base.pipeline,
            datamanager=replace(base.pipeline.datamanager, train_num_rays_per_batch=1024, eval_num_rays_per_batch=1024),
            model=replace(
                base.pipeline.model,
                field=FieldConfig(
                    num_samples_per_ray=24, num_levels=8, max_resolution=256, log2_hashmap_size=15, hidden_dim=32
                ),
                proposal=ProposalConfig(
                    num_samples_per_ray=(48,),
                    max_resolutions=(64,),
                    num_levels=4,
                    log2_hashmap_size=14,
                    weights_anneal_iterations=200,
                ),
                # On a CPU twice as fast as 8192, because the memory of a piece stays small.
                eval_num_rays_per_chunk=1 << 10,
            ),
        ),
    )


aenerf_small = MethodSpecification(
    config=small(aenerf.config), description="AE-NeRF, small: for a CPU and for a first look."
)
