"""Where a run's images and cameras are in the world of its recording, and what the run renders from there."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.alignment import align_most
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.export.camera_model_files import ObservedPoints, PlacedImage
from aenerf_ns.progress import track
from aenerf_ns.recording.recording import SPLITS, ReferenceView, Split
from aenerf_ns.recording.views import thin_views, views_within

# Less opaque pixels see no surface.
_MIN_OPACITY = 0.5


def place_views(run: TrainedRun) -> list[tuple[PlacedImage, Path]]:
    """Place the images of a run's recording where the corrected poses put them.

    An image with a time is at the corrected pose of that time, with the offset on the rig that it has beside the
    dataset's own poses. Other images are carried over by the Sim(3) that best maps the dataset's trajectory, the true
    one where it is known, to the corrected one. An image that is in several splits is a test or validation image.

    Returns:
        The images and their files.

    Raises:
        DataError: the recording has no images.
    """
    recording = run.recording
    split_of: dict[Path, tuple[Split, ReferenceView]] = {}
    for split in SPLITS:
        views = views_within(recording.reference_views[split], run.scene.window)
        for view in views if split == "train" else thin_views(views, recording.max_views):
            split_of[view.file] = (split, view)
    if not split_of:
        raise DataError(run.data, "it has no images", "aenerf export-frames renders images along the trajectory")
    poses = _place_poses(run, [view for _, view in split_of.values()])
    common = Path(os.path.commonpath([file.parent for file in split_of]))
    return [
        (PlacedImage(file.relative_to(common).as_posix(), recording.frame_camera, pose.numpy(), split), file)
        for (file, (split, _)), pose in zip(split_of.items(), poses, strict=True)
    ]


def _place_poses(run: TrainedRun, views: list[ReferenceView]) -> Tensor:
    """Compute the poses (N, 4, 4), OpenCV axes, of views in the frame of the corrected poses."""
    correction = run.model.camera_optimizer
    _, corrected, reference = (run.scene.to_recording(poses) for poses in correction.compared_poses())
    alignment = align_most(corrected, reference).inverse()
    given = run.recording.reference_trajectory
    poses = []
    for view in views:
        if view.time is not None and given.start <= view.time <= given.end:
            on_rig = torch.linalg.inv(homogeneous(given.interpolate(view.time))) @ view.camera_to_world
            if correction.has_ground_truth:
                # From the units of the true trajectory to those of the corrected poses.
                on_rig[:3, 3] *= alignment.scale
            poses.append(corrected_poses(run, torch.tensor([view.time]))[0] @ on_rig)
        else:
            poses.append(homogeneous(alignment(view.camera_to_world[:3])))
    return torch.stack(poses)


@torch.no_grad()
def corrected_poses(run: TrainedRun, times: Tensor) -> Tensor:
    """Compute the corrected poses (N, 4, 4) at (N,) times in nanoseconds: OpenCV axes, in the recording's world."""
    correction = run.model.camera_optimizer
    seconds = correction.trajectory.seconds(times.to(run.device))
    return homogeneous(run.scene.to_recording(correction.pose(seconds)))


def _make_cameras(run: TrainedRun, camera: CameraIntrinsics, poses: Tensor) -> Cameras:
    """Make cameras of the scene at poses (N, 4, 4) of the recording's world, OpenCV axes, on the run's device."""
    return camera.cameras(run.scene.to_scene(poses)).to(run.device)


def render(run: TrainedRun, camera: CameraIntrinsics, pose: Tensor) -> dict[str, Tensor]:
    """Render a view from a pose (3, 4) or (4, 4) in the recording's world, OpenCV axes. The run is in evaluation mode.

    Returns:
        The model's outputs (height, width, channels). ``depth`` is the distance along the ray in units of the
        recording, 0 where no surface is seen.
    """
    outputs = run.model.get_outputs_for_camera(_make_cameras(run, camera, pose[None]))
    depth = torch.where(outputs["accumulation"] > _MIN_OPACITY, outputs["depth"] / run.scene.scale, 0.0)
    return {**outputs, "depth": depth}


def observe_points(run: TrainedRun, images: Sequence[PlacedImage], max_points: int) -> ObservedPoints:
    """Render points on the surfaces that images of one lens see, in the recording's world, at pixels spread over them.

    A ray that sees no surface gives no point, nor does a pixel to which the lens gives no direction. The run is in
    evaluation mode.
    """
    to_recording = run.scene.frame.inverse()
    usable = torch.from_numpy(images[0].camera.pixel_directions()[1])
    generator = torch.Generator().manual_seed(0)
    parts: list[tuple[NDArray, ...]] = []
    # Where there are fewer points than images, some images in between have none.
    counts = np.diff(np.arange(len(images) + 1) * max_points // len(images))
    for index in track(np.flatnonzero(counts).tolist(), "Rendering points"):
        image, count = images[index], int(counts[index])
        size = torch.tensor([image.camera.height, image.camera.width])
        coordinates = (torch.rand(count, 2, generator=generator) * size).floor() + 0.5
        rays = _make_cameras(run, image.camera, torch.from_numpy(image.camera_to_world)[None]).generate_rays(
            torch.zeros(count, 1, dtype=torch.long, device=run.device), coords=coordinates.to(run.device)
        )
        rgb, depth, accumulation = run.model.render_rays(rays, "rgb", "depth", "accumulation")
        row, column = coordinates.long().T
        seen = (accumulation > _MIN_OPACITY)[:, 0] & usable[row, column].to(run.device)
        positions = to_recording.map_points((rays.origins + rays.directions * depth)[seen].cpu().double())
        colors = (255 * rgb[seen].clamp(0, 1)).round().byte().cpu()
        pixels = coordinates.flip(-1)[seen.cpu()].double()
        parts.append((positions.numpy(), colors.numpy(), np.full(len(pixels), index), pixels.numpy()))
    return ObservedPoints(*(np.concatenate(column) for column in zip(*parts, strict=True)))
