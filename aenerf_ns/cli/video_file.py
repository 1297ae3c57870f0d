"""A video file that takes one picture after another."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from pathlib import Path

import imageio_ffmpeg

from aenerf_ns.errors import DataError


def new_video(path: Path, width: int, height: int, frame_rate: float) -> Generator[None, bytes | None, None]:
    """Create a video that is sent (height, width, 3) RGB pictures, as bytes.

    Raises:
        DataError: there is no ffmpeg.
    """
    try:
        # Fails if there is no ffmpeg, before any work is done.
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise DataError(path.name, f"there is no ffmpeg to write it ({error})", "install ffmpeg") from None
    pictures = _write_pictures(path, width, height, frame_rate)
    next(pictures)
    return pictures


def _write_pictures(path: Path, width: int, height: int, frame_rate: float) -> Generator[None, bytes | None, None]:
    # ffmpeg complains of a video without pictures.
    picture = yield
    # H.264 stores colors for blocks of 2 x 2 pixels: an odd size is scaled by a fraction of a pixel.
    with closing(
        imageio_ffmpeg.write_frames(
            str(path), (width, height), fps=frame_rate, macro_block_size=2, ffmpeg_log_level="error"
        )
    ) as video:
        video.send(None)
        while True:
            video.send(picture)
            picture = yield
