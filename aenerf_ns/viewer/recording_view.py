"""Make the arrays, texts and files of a recording that the viewer shows beside the scene."""

from __future__ import annotations

import base64
import math
import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.evaluation.poses import compare_with_ground_truth
from aenerf_ns.events.picture import polarity_picture
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.tum_trajectory import write_tum_trajectory
from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.recording.dataset import EventDataset

# A line of 200 points looks smooth and takes 5 KB.
_MAX_LINE_POINTS = 200
# 2000 points take 30 KB, and a fraction of a training step to compute.
_MAX_POINTS = 2000
# Events whose ray is less opaque have no point.
_MIN_OPACITY = 0.5
# Points this much nearer than the surface are not half hidden by it.
_IN_FRONT = 0.99
_PICTURE_WIDTH = 280
_POSITIVE_COLOR, _NEGATIVE_COLOR = (230, 60, 40), (60, 110, 255)


class RecordingView:
    """Events, trajectories and figures of a run at its present state, with the poses as corrected so far."""

    def __init__(self, model: AENeRFModel, dataset: EventDataset) -> None:
        self._model = model
        self._dataset = dataset
        self.camera = dataset.scene.event_camera
        self.duration = dataset.scene.trajectory.duration
        self.usual_number_of_events = dataset.usual_number_of_events

    @property
    def vertical_field_of_view(self) -> float:
        """The event camera's, in radians, without its distortion."""
        return 2 * float(np.arctan(self.camera.height / 2 / self.camera.fy))

    @torch.no_grad()
    def pose(self, seconds: float) -> NDArray[np.float64]:
        """Return the corrected pose (3, 4) at a time since the trajectory's start: camera-to-world, OpenGL axes."""
        correction = self._model.camera_optimizer
        return correction.pose(torch.tensor([seconds], dtype=torch.float64, device=self._model.device))[0].cpu().numpy()

    def lines(self) -> dict[str, NDArray[np.float64]]:
        """Return points (N, 3) along the ``estimated``, ``corrected`` and, where it is known, ``true`` trajectory.

        They are in the scene, whose frame is that of the corrected poses: the true trajectory is mapped there.
        """
        correction = self._model.camera_optimizer
        estimated, corrected, reference = correction.compared_poses()
        lines = {"estimated": estimated, "corrected": corrected}
        if correction.has_ground_truth:
            lines["true"] = correction.alignment().inverse()(reference)
        count = min(len(estimated), _MAX_LINE_POINTS)
        index = torch.linspace(0, len(estimated) - 1, count, dtype=torch.float64).round().long()
        return {name: poses[index.to(poses.device), :, 3].cpu().numpy() for name, poses in lines.items()}

    def prepare(self) -> None:
        """Read the events now, where they are there and have not been read for training.

        Raises:
            DataError: the events cannot be used.
        """
        if self._dataset.has_events:
            _ = self._dataset.timeline

    def events(self, seconds: float, count: int) -> EventStream:
        """Return about ``count`` events around a time since the trajectory's start; none where there is no file."""
        return self._dataset.events_around(self._dataset.scene.trajectory.start + round(seconds * 1e9), count)

    def picture(self, events: EventStream) -> NDArray[np.uint8]:
        """Return a picture (height, width, 3) of events, as wide as the viewer's panel: red positive, blue negative."""
        scale = _PICTURE_WIDTH / events.width
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
        size = (_PICTURE_WIDTH, max(round(scale * events.height), 1))
        return cv2.resize(polarity_picture(events), size, interpolation=interpolation).astype(np.uint8, copy=False)

    def described_picture(self, events: EventStream, seconds: float) -> str:
        """Return the picture of events around a time with their span, in Markdown."""
        if len(events) == 0:
            path = self._dataset.scene.event_file.path
            return f"There are no events at {path}." if not self._dataset.has_events else "No events around this time."
        middle = self._dataset.scene.trajectory.start + round(seconds * 1e9)
        begin, end = ((int(time) - middle) / 1e6 for time in events.t[[0, -1]])
        data = base64.b64encode(png(self.picture(events))).decode()
        return (
            f"![events](data:image/png;base64,{data})\n\n"
            f"{len(events):,} events from {begin:+.1f} to {end:+.1f} ms: red positive, blue negative"
        )

    @torch.no_grad()
    def points(self, events: EventStream) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return points (N, 3) in the scene of at most 2000 of the events, and their colors (N, 3).

        An event lies on the surface that its pixel sees from the corrected pose of its time, 1 % nearer to the camera.
        """
        if len(events) == 0:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        shown = events[:: math.ceil(len(events) / _MAX_POINTS)]
        device = self._model.device
        seconds = self._model.camera_optimizer.trajectory.seconds(torch.from_numpy(shown.t).to(device))
        cameras = self.camera.cameras(self._model.camera_optimizer.pose(seconds)).to(device)
        coordinates = torch.from_numpy(np.stack([shown.y, shown.x], -1) + 0.5).float().to(device)
        rays = cameras.generate_rays(torch.arange(len(shown), device=device)[:, None], coords=coordinates)
        depth, accumulation = self._model.render_rays(rays, "depth", "accumulation")
        seen = (accumulation[:, 0] > _MIN_OPACITY).cpu().numpy()
        points = (rays.origins + _IN_FRONT * depth * rays.directions).cpu().numpy()
        colors = np.where(shown.p[:, None] > 0, _POSITIVE_COLOR, _NEGATIVE_COLOR).astype(np.uint8)
        return points[seen], colors[seen]

    def figures(self) -> str:
        """Return pose errors, contrast thresholds and the state of the color correction, in Markdown."""
        color = f"**Color correction** {self._model.color_correction.description}"
        return "\n\n".join([self._pose_figures(), self._threshold_figures(), color])

    def _pose_figures(self) -> str:
        correction = self._model.camera_optimizer
        errors = compare_with_ground_truth(correction, self._dataset.scene)
        if errors is not None:
            lines = ["| pose error | given | corrected |", "|---|---|---|"]
            for label, name, form in (
                ("rotation (°)", "rotation_error_degrees", ".3f"),
                ("translation", "translation_error", ".4g"),
                ("ATE, Sim(3)", "ate_rmse_sim3", ".4g"),
            ):
                before, after = errors["estimated"][name], errors["corrected"][name]
                lines.append(f"| {label} | {before:{form}} | {after:{form}} |")
            return "\n".join(lines)
        if not correction.is_learned:
            return "**Poses** as given; the true ones are not known."
        sizes: dict[str, Tensor | float] = {}
        correction.get_metrics_dict(sizes)
        words = ", ".join(f"{name.replace('_', ' ')} {float(value):.4g}" for name, value in sizes.items())
        return f"**Poses**: the true ones are not known. {words}."

    def _threshold_figures(self) -> str:
        sensor, learned = self._model.sensor, self._model.supervision.learned_values()
        positive, negative = sensor.positive_contrast_threshold, sensor.negative_contrast_threshold
        words = ", ".join(f"{name.replace('_', ' ')} {value:.4g}" for name, value in learned.items())
        return f"**Thresholds** C⁺ {positive:.4g}, C⁻ {negative:.4g}" + (f"; learned: {words}" if words else "")

    @torch.no_grad()
    def trajectory_file(self) -> bytes:
        """Return the corrected poses at the times of the given ones in TUM format, in the recording's world."""
        correction = self._model.camera_optimizer
        times = correction.trajectory.times
        poses = self._dataset.scene.to_recording(correction.pose(correction.trajectory.seconds(times)))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "trajectory.txt")
            write_tum_trajectory(path, Trajectory(times.cpu(), poses))
            return path.read_bytes()


def png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture (height, width, 3) as a PNG file."""
    return cv2.imencode(".png", picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
