"""A video along the trajectory: recorded and rendered events, the rendering, its depth, and the image taken there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from nerfstudio.utils import colormaps
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import to_image
from aenerf_ns.events.picture import polarity_picture
from aenerf_ns.export.event_pictures import RenderedEvents, recorded_between
from aenerf_ns.export.placing import corrected_poses
from aenerf_ns.export.rendering import render
from aenerf_ns.progress import progress_bar
from aenerf_ns.recording.images import read_image
from aenerf_ns.recording.recording import SPLITS

# A panel is enlarged by a whole factor until it is so high; a line of text above it is so high.
_LEAST_HEIGHT, _LABEL = 240, 16
_GAP = 4


@torch.no_grad()
def side_by_side(run: TrainedRun, times: Tensor) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures (height, width, 3) of a video, one for each time but the first.

    The panels are the recorded events since the time before, the events that the rendering triggers meanwhile, the
    rendering, its depth, and the last image that was taken until then, where there are images on the trajectory.

    Args:
        run: in evaluation mode.
        times: (N,) in nanoseconds, increasing, at least two.
    """
    recording = run.recording
    lens, device = recording.event_camera, run.device
    triggered = RenderedEvents(recording.sensor, lens.width, lens.height)
    images = _timed_images(run)
    poses = homogeneous(corrected_poses(run, times))
    triggered(render(run, lens, poses[0])["log_radiance"].cpu().numpy())
    depths: tuple[float, float] | None = None
    with progress_bar() as progress:
        task = progress.add_task("Rendering the video", total=len(times) - 1)
        for time, pose, net in zip(
            times[1:].tolist(), poses[1:], recorded_between(recording.event_file, times.numpy()), strict=True
        ):
            outputs = render(run, lens, pose)
            depth = outputs["depth"]
            seen = depth[depth > 0]
            if depths is None and len(seen):
                # Of the first frame, because colours that change their meaning would flicker.
                depths = tuple(torch.quantile(seen.float(), torch.tensor([0.02, 0.98], device=device)).tolist())
            panels = {
                "events, recorded": _event_panel(net),
                "events, rendered": _event_panel(triggered(outputs["log_radiance"].cpu().numpy())),
                "rendering": np.asarray(to_image(outputs["rgb"])),
                "depth": _depth_panel(depth, depths),
            }
            if images:
                panels["image"] = _image_panel(run, images, time)
            yield _joined(panels, f"{(time - int(times[0])) * 1e-9:.3f} s")
            progress.advance(task)


def _timed_images(run: TrainedRun) -> list[tuple[int, Path]]:
    views = run.recording.reference_views
    taken = {view.time: view.file for split in SPLITS for view in views[split] if view.time is not None}
    return sorted((time, file) for time, file in taken.items() if file.is_file())


def _image_panel(run: TrainedRun, images: list[tuple[int, Path]], time: int) -> NDArray[np.uint8]:
    lens = run.recording.event_camera
    last = max(int(np.searchsorted([taken for taken, _ in images], time, side="right")) - 1, 0)
    image = torch.from_numpy(np.array(read_image(images[last][1]).convert("RGB"))) / 255
    shown = to_image(run.model.reference_display(image))
    if shown.size != (lens.width, lens.height):
        # Of another camera than the events.
        shown = shown.resize((lens.width, lens.height))
    return np.asarray(shown)


def _event_panel(net: NDArray[np.int64]) -> NDArray[np.uint8]:
    rows, columns = np.nonzero(net)
    return polarity_picture(columns, rows, net[rows, columns], net.shape[1], net.shape[0])


def _depth_panel(depth: Tensor, ends: tuple[float, float] | None) -> NDArray[np.uint8]:
    near, far = ends or (0.0, 1.0)
    coloured = colormaps.apply_depth_colormap(depth, near_plane=near, far_plane=max(far, near + 1e-9))
    return np.asarray(to_image(torch.where(depth > 0, coloured, 0.0)))


def _joined(panels: dict[str, NDArray[np.uint8]], time: str) -> NDArray[np.uint8]:
    """Return the panels beside each other, with their names above."""
    height, width = next(iter(panels.values())).shape[:2]
    factor = -(-_LEAST_HEIGHT // height)
    height, width = factor * height, factor * width
    # Even sizes, which the video's format wants.
    size = (len(panels) * (width + _GAP) // 2 * 2, (_LABEL + height + 1) // 2 * 2)
    sheet = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(sheet)
    for index, (name, panel) in enumerate(panels.items()):
        left = index * (width + _GAP)
        pen.text((left + 2, 2), name if index else f"{name}   {time}", fill="black")
        sheet.paste(Image.fromarray(panel).resize((width, height), Image.Resampling.NEAREST), (left, _LABEL))
    return np.asarray(sheet)
