"""A small pipeline."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.method.model import AENeRFModelConfig
from aenerf_ns.method.networks import FieldConfig, ProposalConfig
from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.recording.writer import NativeDatasetWriter
from aenerf_ns.training.datamanager import EventDataManagerConfig
from aenerf_ns.training.pipeline import AENeRFPipeline, AENeRFPipelineConfig
from helpers.small_models import SMALL_FIELD, SMALL_PROPOSAL
from helpers.streams import make_stream


def make_pipeline_config(
    folder: Path,
    num_views: int = 2,
    pose_correction: str = "off",
    true_world: Callable[[torch.Tensor], torch.Tensor] | None = None,
) -> AENeRFPipelineConfig:
    """Make the configuration of a small model of a color sensor, and its dataset where it does not exist.

    The validation views are gray, the test views, one more, orange. With ``true_world`` there are true poses, in the
    world that it maps to, where the views are too.
    """
    if not folder.exists():
        camera = CameraIntrinsics(6, 4, 5.0, 5.0, 3.0, 2.0)
        poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
        poses[:, 0, 3] = torch.tensor([-0.1, 0.0, 0.1])
        with NativeDatasetWriter(folder, camera, SensorModel(bayer_pattern="RGGB"), "srgb") as writer:
            writer.events.append(make_stream([(1, 1, 0, 1), (1, 1, 10**9, -1)], 6, 4))
            trajectory = Trajectory([0, 5 * 10**8, 10**9], poses)
            writer.add_trajectories(trajectory, None if true_world is None else trajectory.transform(true_world))
            if true_world is not None:
                poses = homogeneous(true_world(poses))
            for _ in range(num_views):
                writer.add_image("val", np.full((4, 6, 3), 102, np.uint8), poses[0])
            for _ in range(num_views + 1):
                writer.add_image("test", np.full((4, 6, 3), (204, 102, 51), np.uint8), poses[2])
    model = AENeRFModelConfig(
        field=FieldConfig(**SMALL_FIELD),
        proposal=ProposalConfig(**SMALL_PROPOSAL),
        color_correction_num_rays=64,
        camera_optimizer=PoseCorrectionConfig(mode=pose_correction),
    )
    datamanager = EventDataManagerConfig(dataparser=NativeDataParserConfig(data=folder))
    return AENeRFPipelineConfig(datamanager=datamanager, model=model)


def make_pipeline(folder: Path, test_mode: Literal["test", "val"], **options: Any) -> AENeRFPipeline:
    """A small untrained pipeline, with the options of :func:`make_pipeline_config`."""
    config = make_pipeline_config(folder, **options)
    torch.manual_seed(0)
    return config.setup(device="cpu", test_mode=test_mode)
