"""Rendering a trained run from poses in the units of the recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.export.camera_model_files import ObservedPoints, PlacedImage
from aenerf_ns.progress import track

# Less opaque pixels see no surface.
_MIN_OPACITY = 0.5


def _make_cameras(run: TrainedRun, camera: CameraIntrinsics, poses: Tensor) -> Cameras:
    """Make cameras of the scene at poses (N, 4, 4) of the recording's world, OpenCV axes, on the run's device."""
    return camera.cameras(run.scene.to_scene(poses)).to(run.device)


@torch.no_grad()
def render(run: TrainedRun, camera: CameraIntrinsics, pose: Tensor) -> dict[str, Tensor]:
    """Render a view from a pose (3, 4) or (4, 4) in the recording's world, OpenCV axes. The run is in evaluation mode.

    Returns:
        The model's outputs (height, width, channels). ``depth`` is the distance along the ray in units of the
        recording, 0 where no surface is seen.
    """
    outputs = run.model.get_outputs_for_camera(_make_cameras(run, camera, pose[None]))
    depth = torch.where(outputs["accumulation"] > _MIN_OPACITY, outputs["depth"] / run.scene.scale, 0.0)
    return {**outputs, "depth": depth}


@torch.no_grad()
def observe_points(run: TrainedRun, images: Sequence[PlacedImage], max_points: int) -> ObservedPoints:
    """Render points on the surfaces that images see, in the recording's world, at pixels spread over the images.

    A ray that sees no surface gives no point. The run is in evaluation mode.
    """
    to_recording = run.scene.frame.inverse()
    generator = torch.Generator().manual_seed(0)
    parts: list[tuple[NDArray, ...]] = []
    per_image = -(-max_points // len(images))
    for index, image in enumerate(track(images, "Rendering points")):
        size = torch.tensor([image.camera.height, image.camera.width])
        coordinates = (torch.rand(per_image, 2, generator=generator) * size).floor() + 0.5
        rays = _make_cameras(run, image.camera, torch.from_numpy(image.camera_to_world)[None]).generate_rays(
            torch.zeros(per_image, 1, dtype=torch.long, device=run.device), coords=coordinates.to(run.device)
        )
        rgb, depth, accumulation = run.model.render_rays(rays, "rgb", "depth", "accumulation")
        seen = (accumulation > _MIN_OPACITY)[:, 0]
        positions = to_recording.map_points((rays.origins + rays.directions * depth)[seen].cpu().double())
        colors = (255 * rgb[seen].clamp(0, 1)).round().byte().cpu()
        pixels = coordinates.flip(-1)[seen.cpu()].double()
        parts.append((positions.numpy(), colors.numpy(), np.full(len(pixels), index), pixels.numpy()))
    return ObservedPoints(*(np.concatenate(column)[:max_points] for column in zip(*parts, strict=True)))
