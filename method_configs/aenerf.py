"""``ns-train aenerf`` and ``ns-train aenerf-small``: AE-NeRF on hash grids, for a GPU and for minutes on a CPU."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

import torch
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.schedulers import SchedulerConfig
from nerfstudio.plugins.types import MethodSpecification
from nerfstudio.utils.writer import EventName

from aenerf_ns.dataparsers.formats import AutomaticDataParserConfig
from aenerf_ns.method.model import AENeRFModelConfig
from aenerf_ns.method.networks import FieldConfig, ProposalConfig
from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.training.console import ConsoleWriter
from aenerf_ns.training.datamanager import EventDataManagerConfig
from aenerf_ns.training.pipeline import AENeRFPipelineConfig
from aenerf_ns.training.schedules import (
    FusedAdamOptimizerConfig,
    RelativeCosineSchedulerConfig,
    RelativeMultiStepSchedulerConfig,
)
from aenerf_ns.training.trainer import AENeRFTrainerConfig


def optimized_by(scheduler: SchedulerConfig | None = None, **adam: Any) -> dict[str, Any]:
    """Return how a group of parameters is optimized: Adam's options, and by default a rate that falls at milestones."""
    return {"optimizer": FusedAdamOptimizerConfig(**adam), "scheduler": scheduler or RelativeMultiStepSchedulerConfig()}


aenerf = MethodSpecification(
    config=AENeRFTrainerConfig(
        method_name="aenerf",
        max_num_iterations=30000,
        steps_per_save=2000,
        steps_per_eval_batch=500,
        steps_per_eval_image=500,
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        pipeline=AENeRFPipelineConfig(
            datamanager=EventDataManagerConfig(dataparser=AutomaticDataParserConfig()),
            model=AENeRFModelConfig(camera_optimizer=PoseCorrectionConfig(mode="spline")),
        ),
        optimizers={
            # A field that learns slowly holds on to wrong poses (docs/defaults.md).
            "encodings": optimized_by(lr=8e-2, eps=1e-15),
            "networks": optimized_by(lr=1e-2, eps=1e-15, weight_decay=1e-6),
            "proposals": optimized_by(lr=1e-2, eps=1e-15),
            "sensor": optimized_by(lr=0.05),
            # The trainer lowers both rates of the poses where the focal length is long.
            "camera_opt": optimized_by(RelativeCosineSchedulerConfig(), lr=8e-3, eps=1e-15),
            # Closer knots have fewer rays each. Early, or at the full rate, they follow noise (docs/defaults.md).
            "camera_opt_finer": optimized_by(RelativeCosineSchedulerConfig(relative_delay=0.375), lr=2e-3, eps=1e-15),
        },
        # A batch has few rays for each knot of the spline. If poses follow every single batch, the field stays blurred,
        # at lower rates and in longer runs too (docs/defaults.md).
        gradient_accumulation_steps={"camera_opt": 8, "camera_opt_finer": 8},
        logging=LoggingConfig(
            local_writer=LocalWriterConfig(
                _target=ConsoleWriter, enable=True, stats_to_track=(EventName.ITER_TRAIN_TIME, EventName.ETA)
            )
        ),
        viewer=ViewerConfig(websocket_host="127.0.0.1"),
        vis="viewer",
    ),
    description="AE-NeRF: event camera to radiance field, on hash grids.",
)


def small(config: AENeRFTrainerConfig) -> AENeRFTrainerConfig:
    """Return a method with fewer steps, fewer rays and smaller networks. Its name ends with "-small"."""
    config = deepcopy(config)
    config.pipeline.datamanager.train_num_rays_per_batch = 1024
    config.pipeline.datamanager.eval_num_rays_per_batch = 1024
    config.pipeline.model.field = FieldConfig(
        num_samples_per_ray=24, num_levels=8, max_resolution=256, log2_hashmap_size=15, hidden_dim=32
    )
    config.pipeline.model.proposal = ProposalConfig(
        num_samples_per_ray=(48,),
        max_resolutions=(64,),
        num_levels=4,
        log2_hashmap_size=14,
        weights_anneal_iterations=200,
    )
    # On a CPU twice as fast as 8192, because the memory of a piece stays small.
    config.pipeline.model.eval_num_rays_per_chunk = 1 << 10
    # A new configuration, because the schedules follow the number of steps when it is made.
    name = f"{config.method_name}-small"
    return replace(config, method_name=name, max_num_iterations=2000, steps_per_save=1000)  # type: ignore[call-arg]


aenerf_small = MethodSpecification(
    config=small(aenerf.config), description="AE-NeRF, small: for a CPU and for a first look."
)
