"""Frames and depths that a trained run renders along the trajectory, with their cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import to_image
from aenerf_ns.export.camera_model_files import IMAGE_FOLDER, PlacedImage, write_cameras
from aenerf_ns.export.rendering import corrected_poses, observe_points, render
from aenerf_ns.files.text import format_seconds
from aenerf_ns.progress import track
from aenerf_ns.recording.views import IMAGE_LIST

DEPTH_FOLDER = "depth"
DEPTH_UNIT = 1e-3
"""Depth per step of a depth picture, in units of the recording: the framework's own default."""
_MAX_DEPTH = 2**16 - 1
FARTHEST = _MAX_DEPTH * DEPTH_UNIT
"""The largest depth that is written, in units of the recording."""


def export_frames(run: TrainedRun, folder: Path, times: Tensor, num_points: int) -> float:
    """Render frames and depths at (N,) times in nanoseconds, and write them with their cameras to a new folder.

    Depth pictures have 16 bits and hold the distance along the optical axis, in thousandths of the recording's unit,
    0 where no surface is seen, where it is too far, and where the lens gives a pixel no direction. At most
    ``num_points`` points of the scene are written. The run is in evaluation mode.

    Returns:
        The share of the pixels that see a surface too far away for their depth to be written.
    """
    camera = run.recording.event_camera
    directions, usable = camera.pixel_directions()
    # Factors from distances along the ray to distances along the optical axis, which looks along -z.
    along_axis = torch.from_numpy(np.where(usable[..., None], -directions[..., 2:], 0))
    poses = corrected_poses(run, times)
    for name in (IMAGE_FOLDER, DEPTH_FOLDER):
        (folder / name).mkdir(parents=True)
    images, lines, num_far = [], [], 0
    for index, pose in enumerate(track(poses, "Rendering frames")):
        outputs = render(run, camera, pose)
        name = f"{index:06d}.png"
        to_image(outputs["rgb"]).save(folder / IMAGE_FOLDER / name)
        depth = (outputs["depth"].cpu() * along_axis / DEPTH_UNIT).round()[..., 0].numpy()
        num_far += int((depth > _MAX_DEPTH).sum())
        depth[depth > _MAX_DEPTH] = 0
        Image.fromarray(depth.astype(np.uint16)).save(folder / DEPTH_FOLDER / name)
        images.append(PlacedImage(name, camera, pose.numpy(), depth=f"{DEPTH_FOLDER}/{name}"))
        lines.append(f"{format_seconds(int(times[index]))} {IMAGE_FOLDER}/{name}\n")
    (folder / IMAGE_LIST).write_text("".join(lines), "utf8")
    write_cameras(folder, images, observe_points(run, images, num_points))
    return num_far / (len(images) * camera.width * camera.height)
