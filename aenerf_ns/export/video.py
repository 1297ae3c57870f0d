"""A video along the trajectory: recorded and rendered events, the rendering, its depth, and the image taken there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from nerfstudio.utils import colormaps
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import to_image
from aenerf_ns.events.picture import net_picture
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.export.rendering import corrected_poses, render
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.progress import track
from aenerf_ns.recording.images import read_image

# Minimum height of a panel, height of the line of text above it, and gap between panels, in pixels.
_MIN_HEIGHT, _LABEL, _GAP = 240, 16, 4


def render_panels(run: TrainedRun, times: Tensor) -> Iterator[NDArray[np.uint8]]:
    """Render the pictures (height, width, 3) of a video, one for each of the (N,) times in nanoseconds but the first.

    The panels are the recorded events since the time before, the events that the rendering triggers meanwhile, the
    rendering, its depth, and the last image that was taken until then (black before the first), where there are images
    on the trajectory. The run is in evaluation mode.
    """
    recording = run.recording
    camera, sensor = recording.event_camera, recording.sensor
    # Rendered changes agree with the thresholds that were learned along with them.
    ratio = run.model.supervision.learned_values().get("contrast_threshold_ratio")
    if ratio is not None:
        sensor = replace(sensor, positive_contrast_threshold=ratio * sensor.negative_contrast_threshold)
    trigger = RenderedEvents(sensor, camera.width, camera.height)
    images = recording.frames
    poses = corrected_poses(run, times)
    trigger(render(run, camera, poses[0])["log_radiance"].cpu().numpy())
    recorded = sum_recorded_events(recording.event_file, times.numpy())
    depth_range: tuple[float, float] | None = None
    for time, pose, net in zip(times[1:].tolist(), track(poses[1:], "Rendering the video"), recorded, strict=True):
        outputs = render(run, camera, pose)
        depth = outputs["depth"]
        seen = depth[depth > 0]
        if depth_range is None and len(seen):
            # The first frame's, because colors that change their meaning would flicker.
            near, far = torch.quantile(seen.float(), torch.tensor([0.02, 0.98], device=run.device)).tolist()
            depth_range = near, far
        panels = {
            "events, recorded": net_picture(net),
            "events, rendered": net_picture(trigger(outputs["log_radiance"].cpu().numpy())),
            "rendering": np.asarray(to_image(outputs["rgb"])),
            "depth": _depth_panel(depth, depth_range),
        }
        if images:
            panels["image"] = _image_panel(run, images, time)
        yield _join_panels(panels, f"{(time - int(times[0])) * 1e-9:.3f} s")


def _image_panel(run: TrainedRun, images: list[tuple[int, Path]], time: int) -> NDArray[np.uint8]:
    camera = run.recording.event_camera
    until = [file for taken, file in images if taken <= time]
    if not until:
        return np.zeros((camera.height, camera.width, 3), np.uint8)
    image = torch.from_numpy(np.array(read_image(until[-1]).convert("RGB"))) / 255
    # The image may be of another camera than the events.
    return np.asarray(to_image(run.model.reference_display(image)).resize((camera.width, camera.height)))


def _depth_panel(depth: Tensor, depth_range: tuple[float, float] | None) -> NDArray[np.uint8]:
    near, far = depth_range or (0.0, 1.0)
    colored = colormaps.apply_depth_colormap(depth, near_plane=near, far_plane=max(far, near + 1e-9))
    return np.asarray(to_image(torch.where(depth > 0, colored, 0.0)))


def _join_panels(panels: dict[str, NDArray[np.uint8]], time: str) -> NDArray[np.uint8]:
    """Put the panels beside each other, with their names above."""
    height, width = next(iter(panels.values())).shape[:2]
    factor = -(-_MIN_HEIGHT // height)
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


def sum_recorded_events(events: EventFile, times: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Yield the (height, width) sums of polarities between each two of (N,) times in nanoseconds, the earlier included.

    The events are read once, in pieces.
    """
    chunks = events.chunks()
    chunk = next(chunks, None)
    for ends in pairwise(times):
        net = np.zeros((events.height, events.width), np.int64)
        while chunk is not None:
            inside = slice(*np.searchsorted(chunk.t, ends))
            np.add.at(net, (chunk.y[inside], chunk.x[inside]), chunk.p[inside])
            if inside.stop < len(chunk):
                break
            # The next chunk may continue this interval.
            chunk = next(chunks, None)
        yield net


class RenderedEvents:
    """Trigger events of consecutive renderings as the sensor does (paper, eq. 5), but without a refractory period."""

    def __init__(self, sensor: SensorModel, width: int, height: int) -> None:
        self._sensor = sensor
        self._channel = sensor.channels(width, height)[..., None]
        self._reference: NDArray[np.float64] | None = None

    def __call__(self, log_radiance: NDArray[np.floating]) -> NDArray[np.int64]:
        """Return the (height, width) sums of polarities since the call before; none at the first call.

        ``log_radiance`` is (height, width, channels).
        """
        seen = np.take_along_axis(log_radiance.astype(np.float64), self._channel, -1)[..., 0]
        if self._reference is None:
            self._reference = seen
        change = seen - self._reference
        sensor = self._sensor
        threshold = np.where(change > 0, sensor.positive_contrast_threshold, sensor.negative_contrast_threshold)
        count = np.trunc(change / threshold)
        self._reference = self._reference + count * threshold
        return count.astype(np.int64)
