"""Writing a video file."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from itertools import chain
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError


def write_video(path: Path, pictures: Iterable[NDArray[np.uint8]], frame_rate: float) -> int:
    """Write (height, width, 3) RGB pictures, and count them. Without pictures, no file is written.

    Raises:
        DataError: there is no ffmpeg.
        OSError: ffmpeg cannot write the file, such as on a full disk.
    """
    try:
        # Fails if there is no ffmpeg, before any work is done.
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise DataError(path.name, f"there is no ffmpeg to write it ({error})", "install ffmpeg") from None
    pictures = iter(pictures)
    first = next(pictures, None)
    if first is None:
        return 0
    # ffmpeg takes a relative name with a colon for a protocol.
    path = path.absolute()
    # H.264 stores colors for blocks of 2 x 2 pixels: an odd size is scaled by a fraction of a pixel.
    video = imageio_ffmpeg.write_frames(
        str(path), first.shape[1::-1], fps=frame_rate, macro_block_size=2, ffmpeg_log_level="error"
    )
    with closing(video):
        video.send(None)
        count = 0
        for picture in chain([first], pictures):
            video.send(picture.tobytes())
            count += 1
    # imageio-ffmpeg does not look at the exit status.
    try:
        written = imageio_ffmpeg.count_frames_and_secs(path)[0]
    except RuntimeError:
        written = 0
    if written < count:
        raise OSError(f"ffmpeg wrote {written} of {count} frames")
    return count
