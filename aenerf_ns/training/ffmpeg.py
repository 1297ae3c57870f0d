"""An ffmpeg for ns-render, on machines without one."""

from __future__ import annotations

import os
import shutil
from pathlib import Path


def provide_ffmpeg() -> None:
    """Put the ffmpeg binary that imageio-ffmpeg ships on this process' PATH, where there is no other ffmpeg.

    Nerfstudio's ns-render refuses to render without a program of that name, and pip cannot install one. Never fails:
    where no ffmpeg can be provided, ns-render tells the user what to install.
    """
    if shutil.which("ffmpeg") is not None:
        return
    try:
        import imageio_ffmpeg

        binary = Path(imageio_ffmpeg.get_ffmpeg_exe())
        # The shipped file has another name, so it needs a link. The folder is named after the version.
        folder = Path.home() / ".cache" / "aenerf-ns" / binary.stem
        folder.mkdir(parents=True, exist_ok=True)
        link = folder / "ffmpeg"
        if not link.exists() or not link.samefile(binary):
            # Replaced in one step, because another process may do the same at the same time.
            new = folder / f"ffmpeg.{os.getpid()}"
            new.unlink(missing_ok=True)
            new.symlink_to(binary)
            new.replace(link)
    except Exception:
        # No failure here may end evaluation or rendering.
        return
    os.environ["PATH"] = f"{os.environ.get('PATH', '')}{os.pathsep}{folder}"
