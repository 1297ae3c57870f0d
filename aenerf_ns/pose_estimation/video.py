"""The frames of a video, or of a folder of images with their times."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from aenerf_ns.errors import DataError, reading, require_file
from aenerf_ns.files.limits import MAX_TIME
from aenerf_ns.recording.images import open_image, read_image, require_8_bits
from aenerf_ns.recording.views import IMAGE_LIST, read_image_list


@dataclass(frozen=True)
class Video:
    """Frames of one size and their times. Iterating over it reads one frame at a time, from the first one each time.

    Yields:
        (height, width, 3) uint8 RGB frames, in the order of time.

    Attributes:
        source: the file or folder.
        width: pixel columns.
        height: pixel rows.
        times: (N,) int64 nanoseconds, increasing, at least two.
        read_frames: reads the frames from the first one on.
    """

    source: Path
    width: int
    height: int
    times: NDArray[np.int64]
    read_frames: Callable[[], Iterator[NDArray[np.uint8]]]

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        count = 0
        for count, frame in enumerate(self.read_frames(), start=1):
            if frame.shape != (self.height, self.width, 3):
                size = f"{frame.shape[1]} x {frame.shape[0]}"
                problem = f"frame {count - 1} has {size} pixels, the first one {self.width} x {self.height}"
                raise DataError(self.source, problem, "bring all frames to one size")
            yield frame
        if count != len(self.times):
            raise DataError(self.source, f"only {count} of {len(self.times)} frames can be read", "copy it again")


def open_video(source: Path, frame_rate: float | None = None) -> Video:
    """Open a video file, or a folder of images that the list images.txt in it gives times (t[s] file, on each line).

    Args:
        source: the file, of any format that OpenCV's ffmpeg decodes, or the folder.
        frame_rate: frames per second, in place of the times that the file or the list states. The first frame is then
            at time 0.

    Raises:
        DataError: the video cannot be read, has fewer than two frames, or has times that do not increase.
    """
    if source.is_dir():
        video = _open_folder(source)
    elif source.is_file():
        video = _open_file(source, frame_rate is None)
    else:
        raise DataError(source, "there is no such video", "give a file, or a folder of images")
    times = video.times
    if frame_rate is not None:
        if not 0 < frame_rate < math.inf:
            raise DataError(source, f"a frame rate of {frame_rate}", "give a positive number of frames a second")
        times = np.rint(np.arange(len(times)) * (1e9 / frame_rate)).astype(np.int64)
    if len(times) < 2:
        raise DataError(source, f"{len(times)} frames", "events happen between frames: give two or more")
    backward = np.flatnonzero(np.diff(times) <= 0)
    if len(backward):
        later = int(backward[0]) + 1
        problem = f"frame {later} is at {times[later]} ns, not after the frame before it at {times[later - 1]} ns"
        raise DataError(source, problem, "sort the frames by time, or state their rate as --frame-rate")
    return Video(source, video.width, video.height, times, video.read_frames)


def _open_folder(source: Path) -> Video:
    require_file(source / IMAGE_LIST, "write a line for each frame into it: time[s] file")
    images = read_image_list(source / IMAGE_LIST)
    if not images:
        raise DataError(source / IMAGE_LIST, "it lists no frames", "write a line for each: time[s] file")

    def read() -> Iterator[NDArray[np.uint8]]:
        for _, file in images:
            image = read_image(file)
            require_8_bits(image, file)
            yield np.asarray(image.convert("RGB"))

    with open_image(images[0][1]) as image:
        width, height = image.size
    return Video(source, width, height, np.array([time for time, _ in images], np.int64), read)


def _open_file(source: Path, needs_times: bool) -> Video:
    def read() -> Iterator[NDArray[np.uint8]]:
        capture = _open_capture(source)
        while True:
            with silent_opencv():
                decoded, frame = capture.read()
            if not decoded:
                return
            yield np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)

    capture, milliseconds = _open_capture(source), []
    # Every frame is decoded, because a container's own number and rate of frames may be wrong.
    with silent_opencv():
        while capture.grab():
            milliseconds.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    frame = next(read(), None)
    if frame is None:
        raise DataError(source, "no frame of it can be decoded", "convert it to another format")
    stated = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    if len(milliseconds) < stated:
        # No error, because some containers only state a guess.
        line = f"{source}: {len(milliseconds)} of the {stated} frames that it states can be decoded."
        CONSOLE.print(line, markup=False, soft_wrap=True)
    # Some containers state no times, or the largest number there is.
    known = np.abs(milliseconds) < MAX_TIME * 1e-6
    if needs_times and len(known) > 1 and not known.all():
        raise DataError(source, "it states no times of its frames", "state their rate as --frame-rate")
    times = np.rint(np.where(known, milliseconds, 0) * 1e6).astype(np.int64)
    return Video(source, frame.shape[1], frame.shape[0], times, read)


def _open_capture(source: Path) -> cv2.VideoCapture:
    with reading(source):
        source.open("rb").close()
    # The other backends take the numbers in a file's name for a pattern of many files, and ffmpeg takes a relative name
    # with a colon for a protocol.
    with silent_opencv():
        capture = cv2.VideoCapture(str(source.absolute()), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise DataError(source, "not a video that can be read", "convert it to MP4, or give a folder of images")
    return capture


@contextmanager
def silent_opencv() -> Iterator[None]:
    """Keep OpenCV and its ffmpeg from printing errors of their own beside the one line."""
    name = "OPENCV_FFMPEG_LOGLEVEL"
    level, before = cv2.getLogLevel(), os.environ.get(name)
    cv2.setLogLevel(0)
    # ffmpeg's number for silence.
    os.environ[name] = "-8" if before is None else before
    try:
        yield
    finally:
        cv2.setLogLevel(level)
        if before is None:
            del os.environ[name]
