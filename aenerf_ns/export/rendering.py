"""Rendering a trained run from poses in the units of the recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.export.camera_model_files import ObservedPoints, PlacedImage
from aenerf_ns.progress import progress_bar

# Less opaque pixels see no surface.
OPAQUE = 0.5


def scene_camera(run: TrainedRun, lens: CameraIntrinsics, poses: Tensor) -> Cameras:
    """Return cameras of the scene at poses (N, 4, 4) of the recording's world, OpenCV axes, on the run's device."""
    return lens.cameras(run.scene.to_scene(poses)).to(run.device)


@torch.no_grad()
def render(run: TrainedRun, lens: CameraIntrinsics, pose: Tensor) -> dict[str, Tensor]:
    """Render a view.

    Args:
        run: in evaluation mode.
        lens: of the camera.
        pose: (4, 4) or (3, 4) in the recording's world, OpenCV axes.

    Returns:
        The model's outputs (height, width, channels). ``depth`` is the distance along the ray in units of the
        recording, 0 where no surface is seen.
    """
    outputs = run.model.get_outputs_for_camera(scene_camera(run, lens, pose[None]))
    scale = run.scene.scale
    depth = torch.where(outputs["accumulation"] > OPAQUE, outputs["depth"] / scale, 0.0)
    return {**outputs, "depth": depth}


@torch.no_grad()
def points_seen(run: TrainedRun, images: Sequence[PlacedImage], most: int) -> ObservedPoints:
    """Return points on the surfaces that images see, in the recording's world, at pixels spread over the images.

    Args:
        run: in evaluation mode.
        images: with their poses.
        most: number of points at most. Rays that see no surface give none.
    """
    to_recording = run.scene.frame.inverse()
    generator = torch.Generator().manual_seed(0)
    parts: list[tuple[NDArray, ...]] = []
    per_image = -(-most // len(images))
    chunk = run.model.config.eval_num_rays_per_chunk
    with progress_bar() as progress:
        task = progress.add_task("Rendering points", total=len(images))
        for index, image in enumerate(images):
            lens = image.camera
            size = torch.tensor([lens.height, lens.width])
            coordinates = (torch.rand(per_image, 2, generator=generator) * size).floor() + 0.5
            camera = scene_camera(run, lens, torch.from_numpy(image.camera_to_world)[None])
            rays = camera.generate_rays(
                torch.zeros(per_image, 1, dtype=torch.long, device=run.device),
                coords=coordinates.to(run.device),
            )
            for begin in range(0, per_image, chunk):
                part = rays[begin : begin + chunk]
                outputs = run.model(replace(part))
                seen = (outputs["accumulation"] > OPAQUE)[:, 0]
                positions = (part.origins + part.directions * outputs["depth"])[seen]
                colors = (255 * outputs["rgb"][seen].clamp(0, 1)).round().byte()
                pixels = coordinates[begin : begin + chunk].flip(-1)[seen.cpu()]
                parts.append(
                    (
                        to_recording.map_points(positions.cpu().double()).numpy(),
                        colors.cpu().numpy(),
                        np.full(len(pixels), index),
                        pixels.double().numpy(),
                    )
                )
            progress.advance(task)
    columns = (np.concatenate(column)[:most] for column in zip(*parts, strict=True))
    return ObservedPoints(*columns)
