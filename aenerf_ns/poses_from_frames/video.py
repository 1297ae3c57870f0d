"""The frames of a video, or of a folder of images with their times."""

from __future__ import annotations

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.limits import MAX_TIME
from aenerf_ns.recording.images import image_size_and_mode, read_image, require_8_bits
from aenerf_ns.recording.views import IMAGE_LIST, read_image_list

# OpenCV's ffmpeg prints errors of its own beside the one line, as OpenCV does. The number stands for silence.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


class Video(ABC):
    """Frames of one size and their times. Iterating over it reads one frame at a time, from the first one each time.

    Yields:
        (height, width, 3) uint8 RGB frames, in the order of time.

    Attributes:
        source: the file or folder.
        width: pixel columns.
        height: pixel rows.
        times: (N,) int64 nanoseconds, increasing, at least two.
    """

    def __init__(self, source: Path, size: tuple[int, int], times: NDArray[np.int64], frame_rate: float | None) -> None:
        if frame_rate is not None:
            if not 0 < frame_rate < math.inf:
                raise DataError(source, f"a frame rate of {frame_rate}", "give a positive number of frames a second")
            times = np.rint(np.arange(len(times)) * (1e9 / frame_rate)).astype(np.int64)
        if len(times) < 2:
            raise DataError(source, f"{len(times)} frames", "events happen between frames: give two or more")
        backward = np.flatnonzero(np.diff(times) <= 0)
        if len(backward):
            later = int(backward[0]) + 1
            raise DataError(
                source,
                f"frame {later} is at {times[later]} ns, not after the frame before it at {times[later - 1]} ns",
                "sort the frames by time, or state their rate as --frame-rate",
            )
        self.source, self.times = source, times
        self.width, self.height = size

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        count = 0
        for count, frame in enumerate(self._read(), start=1):
            if frame.shape != (self.height, self.width, 3):
                raise DataError(
                    self.source,
                    f"frame {count - 1} has {frame.shape[1]} x {frame.shape[0]} pixels, the first one {self.width} x "
                    f"{self.height}",
                    "bring all frames to one size",
                )
            yield frame
        if count != len(self.times):
            raise DataError(self.source, f"only {count} of {len(self.times)} frames can be read", "copy it again")

    @abstractmethod
    def _read(self) -> Iterator[NDArray[np.uint8]]:
        """Read the frames, one after the other."""


def open_video(source: Path, frame_rate: float | None = None) -> Video:
    """Open a video file, or a folder of images that the list images.txt in it gives times (t[s] file, on each line).

    Args:
        source: the file, of any format that OpenCV's ffmpeg decodes, or the folder.
        frame_rate: frames a second, in place of the times that the file or the list states. The first frame is then at
            time 0.

    Raises:
        DataError: the video cannot be read, has fewer than two frames, or has times that do not increase.
    """
    if source.is_dir():
        return _ImageFolder(source, frame_rate)
    if not source.is_file():
        raise DataError(source, "there is no such video", "give a file, or a folder of images")
    return _VideoFile(source, frame_rate)


class _ImageFolder(Video):
    def __init__(self, source: Path, frame_rate: float | None) -> None:
        images = read_image_list(source / IMAGE_LIST)
        self._files = [file for _, file in images]
        if not images:
            raise DataError(source / IMAGE_LIST, "it lists no frames", "write a line for each: time[s] file")
        size, _ = image_size_and_mode(self._files[0])
        super().__init__(source, size, np.array([time for time, _ in images], np.int64), frame_rate)

    def _read(self) -> Iterator[NDArray[np.uint8]]:
        for file in self._files:
            image = read_image(file)
            require_8_bits(image.mode, file)
            yield np.asarray(image.convert("RGB"))


class _VideoFile(Video):
    def __init__(self, source: Path, frame_rate: float | None) -> None:
        self._path = source
        capture, milliseconds = self._open(), []
        # Every frame is decoded, because a container's own number and rate of frames may be wrong.
        while capture.grab():
            milliseconds.append(capture.get(cv2.CAP_PROP_POS_MSEC))
        frame = next(self._read(), None)
        if frame is None:
            raise DataError(source, "no frame of it can be decoded", "convert it to another format")
        stated = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if len(milliseconds) < stated:
            # No error, because some containers only state a guess.
            CONSOLE.print(
                f"{source}: {len(milliseconds)} of the {stated} frames that it states can be decoded.", soft_wrap=True
            )
        # Some containers state none, or the largest number there is.
        known = np.abs(milliseconds) < MAX_TIME * 1e-6
        if frame_rate is None and len(known) > 1 and not known.all():
            raise DataError(source, "it states no times of its frames", "state their rate as --frame-rate")
        times = np.rint(np.where(known, milliseconds, 0) * 1e6).astype(np.int64)
        super().__init__(source, (frame.shape[1], frame.shape[0]), times, frame_rate)

    def _read(self) -> Iterator[NDArray[np.uint8]]:
        capture = self._open()
        while True:
            decoded, frame = capture.read()
            if not decoded:
                return
            yield np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)

    def _open(self) -> cv2.VideoCapture:
        with reading(self._path):
            self._path.open("rb").close()
        cv2.setLogLevel(0)
        # Of all backends only this one: others take the numbers in a file's name for a pattern of many files.
        capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise DataError(self._path, "not a video that can be read", "convert it to MP4, or give a folder of images")
        return capture
