"""Where the images of a recording were taken, in the frame of the corrected poses and the units of the recording."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import Tensor

from aenerf_ns.camera.alignment import align
from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.export.camera_model_files import PlacedImage
from aenerf_ns.recording.recording import SPLITS, ReferenceView, Split
from aenerf_ns.recording.views import thin_views, views_within


def place_views(run: TrainedRun) -> list[tuple[PlacedImage, Path]]:
    """Place the images of a run's recording where the corrected poses put them.

    An image with a time is at the corrected pose of that time, with the offset on the rig that it has beside the
    dataset's own poses. Other images are carried over by the Sim(3) that best maps the dataset's trajectory, the true
    one where it is known, to the corrected one. An image that is in several splits is a test or validation image.

    Returns:
        The images and their files.

    Raises:
        DataError: the recording has no images, or their files are missing.
    """
    recording = run.recording
    split_of: dict[Path, tuple[Split, ReferenceView]] = {}
    for split in SPLITS:
        views = views_within(recording.reference_views[split], run.scene.window)
        for view in views if split == "train" else thin_views(views, recording.max_views):
            split_of[view.file] = (split, view)
    found = {file: entry for file, entry in split_of.items() if file.is_file()}
    if not found:
        problem = "its images are missing" if split_of else "it has no images"
        raise DataError(run.data, problem, "aenerf export-frames renders images along the trajectory")
    poses = _place_poses(run, [view for _, view in found.values()])
    common = Path(os.path.commonpath([file.parent for file in found]))
    return [
        (PlacedImage(file.relative_to(common).as_posix(), recording.frame_camera, pose.numpy(), split), file)
        for (file, (split, _)), pose in zip(found.items(), poses, strict=True)
    ]


def _place_poses(run: TrainedRun, views: list[ReferenceView]) -> Tensor:
    """Compute the poses (N, 4, 4), OpenCV axes, of views in the frame of the corrected poses."""
    correction = run.model.camera_optimizer
    _, corrected, reference = (run.scene.to_recording(poses) for poses in correction.compared_poses())
    alignment = align(corrected, reference).inverse()
    given = run.recording.reference_trajectory
    poses = []
    for view in views:
        if view.time is not None and given.start <= view.time <= given.end:
            on_rig = torch.linalg.inv(homogeneous(given.interpolate(view.time))) @ view.camera_to_world
            if correction.has_ground_truth:
                # From the units of the true trajectory to those of the corrected poses.
                on_rig[:3, 3] *= alignment.scale
            poses.append(homogeneous(corrected_poses(run, torch.tensor([view.time])))[0] @ on_rig)
        else:
            poses.append(homogeneous(alignment(view.camera_to_world[:3])))
    return torch.stack(poses)


@torch.no_grad()
def corrected_poses(run: TrainedRun, times: Tensor) -> Tensor:
    """Compute the corrected poses (N, 3, 4) at (N,) times in nanoseconds: OpenCV axes, in the recording's world."""
    correction = run.model.camera_optimizer
    seconds = correction.trajectory.seconds(times.to(run.device))
    return run.scene.to_recording(correction.pose(seconds))
