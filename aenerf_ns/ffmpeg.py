"""An ffmpeg for ns-render on machines without one."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path


def provide_ffmpeg() -> None:
    """Puts the ffmpeg binary that imageio-ffmpeg ships on this process' PATH where there is no other.

    Nerfstudio's ns-render refuses to start without a program of that name, and pip cannot install one.
    """
    if shutil.which("ffmpeg") is not None:
        return
    import imageio_ffmpeg

    try:
        binary = Path(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError:
        # No binary for this platform: ns-render will tell the user what to install.
        return
    # The shipped file has another name. The folder is the user's own and is made once for each binary.
    folder = Path(tempfile.gettempdir()) / f"aenerf-ns-{os.getuid()}" / binary.stem
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    link = folder / "ffmpeg"
    if not link.exists():
        link.symlink_to(binary)
    os.environ["PATH"] = f"{os.environ.get('PATH', '')}{os.pathsep}{folder}"
