"""Turn a video into events: what an event sensor at the camera's position would have seen."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from aenerf_ns.camera.image_encoding import decode, to_channels
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.pose_estimation.video import Video
from aenerf_ns.progress import track
from aenerf_ns.simulator.esim import NOISELESS, EventSimulator
from aenerf_ns.simulator.frames import DISPLACEMENT_PERCENTILE
from aenerf_ns.simulator.options import Interpolation, SensorNoise

_GRAY_LEVELS = decode(np.arange(256) / 255, "srgb")


class VideoInterval(NamedTuple):
    """A frame of a video, and what the sensor fires since the frame before it."""

    frame: NDArray[np.uint8]  # (height, width, 3), sRGB
    time: int  # of the frame, in nanoseconds
    events: EventStream  # since the frame before, as :class:`EventSimulator` returns them


def quantization_epsilon(sensor: SensorModel) -> float:
    """Return the radiance that is added before the logarithm, because 8 bits of sRGB are coarse near black.

    With it, the step from gray level 0 to 2 of 255 is exactly the smaller contrast threshold: log((L(2) + ε) / ε) = C,
    where L is linear radiance. For C of 0.1 or more, any other two levels that are 2 apart differ by less. So a pixel
    that flickers by one gray level does not keep firing.
    """
    threshold = min(sensor.positive_contrast_threshold, sensor.negative_contrast_threshold)
    return float(_GRAY_LEVELS[2]) / math.expm1(threshold)


def video_simulator(video: Video, sensor: SensorModel, noise: SensorNoise = NOISELESS, seed: int = 0) -> EventSimulator:
    """Make the sensor that is to see a video. It adds :func:`quantization_epsilon` before the logarithm."""
    epsilon = quantization_epsilon(sensor)
    return EventSimulator(video.width, video.height, sensor, noise, log_epsilon=epsilon, seed=seed)


def video_events(
    video: Video, simulator: EventSimulator, interpolation: Interpolation = "flow", max_displacement: float = 0.5
) -> Iterator[VideoInterval]:
    """Simulate an event sensor that sees a video. One frame after the other is read, so memory does not grow.

    sRGB values are decoded to linear radiance.

    Args:
        video: the frames.
        simulator: the sensor, see :func:`video_simulator`.
        interpolation: "linear": log-radiance is linear in time between two frames. "flow": frames along the optical
            flow are put between them (:class:`FlowInterpolation`), and log-radiance is linear between all of these.
        max_displacement: pixels that 99 % of the picture may move between two frames that "flow" puts in.

    Raises:
        DataError: a frame cannot be read or has another size than the first one.
        ValueError: the frames are too small for optical flow.
    """
    epsilon = simulator.log_epsilon
    flow = FlowInterpolation(video.width, video.height, max_displacement) if interpolation == "flow" else None
    before: tuple[NDArray[np.uint8], NDArray[np.float64], int] | None = None
    for frame, time in zip(video, track(video.times.tolist(), "Simulating events"), strict=True):
        seen = to_channels(torch.from_numpy(_GRAY_LEVELS[frame]), simulator.sensor.num_channels).squeeze(-1).numpy()
        pieces = []
        if flow is not None and before is not None:
            first_frame, first_seen, start = before
            logs = (np.log(picture + epsilon) for picture in (first_seen, seen))
            for fraction, log_between in flow.between(first_frame, frame, *logs):
                radiance = np.maximum(np.exp(log_between) - epsilon, 0)
                pieces.append(simulator(radiance, start + round(fraction * (time - start))))
        pieces.append(simulator(seen, time))
        yield VideoInterval(frame, time, EventStream.concatenate(pieces))
        before = frame, seen, time


class FlowInterpolation:
    """Put pictures between two frames, along OpenCV's DIS optical flow (Kroeger et al., ECCV 2016).

    At the fraction s of the interval, a pixel looks back to the first frame along s² B − s(1 − s) F and ahead to the
    second frame along (1 − s)² F − s(1 − s) B, where F is the flow from the first frame to the second, and B the flow
    back (Super SloMo, Jiang et al., CVPR 2018, eq. 4). For a translation this is exact. The two looks are blended
    linearly in log-radiance, so that without motion the picture is linear in time.

    Args:
        width, height: of the frames, in pixels.
        max_displacement: pixels that 99 % of the picture may move between two pictures.

    Raises:
        ValueError: the frames are too small for optical flow.
    """

    def __init__(self, width: int, height: int, max_displacement: float) -> None:
        # Smaller pictures than the patches of the flow fail, or have no flow.
        if min(width, height) < 12:
            raise ValueError(
                f"optical flow needs frames of 12 x 12 pixels or more, not {width} x {height}: --interpolation linear"
            )
        self._max_displacement = max_displacement
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._columns, self._rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))

    def between(
        self,
        first_frame: NDArray[np.uint8],
        second_frame: NDArray[np.uint8],
        first_log: NDArray[np.float64],
        second_log: NDArray[np.float64],
    ) -> Iterator[tuple[float, NDArray[np.float64]]]:
        """Yield fractions of the interval, increasing in (0, 1), and the log-radiance at these.

        Args:
            first_frame, second_frame: (height, width, 3) RGB, from which the flow is found.
            first_log, second_log: (height, width) or (height, width, 3) log-radiance, which moves along the flow.
        """
        first_gray, second_gray = (cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in (first_frame, second_frame))
        # No guess of the flow to start from.
        forward = self._flow.calc(first_gray, second_gray, np.empty(0))
        backward = self._flow.calc(second_gray, first_gray, np.empty(0))
        displacement = max(
            np.percentile(np.linalg.norm(flow, axis=-1), DISPLACEMENT_PERCENTILE) for flow in (forward, backward)
        )
        steps = math.ceil(displacement / self._max_displacement)
        for fraction in np.arange(1, steps, dtype=np.float32) / np.float32(steps):
            rest = 1 - fraction
            back = self._look(first_log, fraction * (fraction * backward - rest * forward))
            ahead = self._look(second_log, rest * (rest * forward - fraction * backward))
            yield float(fraction), rest * back + fraction * ahead

    def _look(self, log_radiance: NDArray[np.float64], offsets: NDArray[np.float32]) -> NDArray[np.float64]:
        # Linear interpolation would blur the picture by an amount that changes with the fraction, which fires events.
        columns, rows = self._columns + offsets[..., 0], self._rows + offsets[..., 1]
        looked = cv2.remap(log_radiance, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(looked, np.float64)
