"""What a command needs of the machine: the device it asks for, and a program that ns-render insists on."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import torch

from aenerf_ns.errors import DataError


def require_device(device: str) -> None:
    """Raise a DataError if a GPU is asked for and there is none."""
    if device == "cuda" and not torch.cuda.is_available():
        raise DataError(
            "--machine.device-type cuda",
            "no GPU can be used",
            "train on the CPU with: ns-train aenerf-small --machine.device-type cpu ..., or install a driver that fits "
            "the CUDA of PyTorch",
        )


def provide_ffmpeg() -> None:
    """Put the binary of imageio-ffmpeg on this process' PATH under the name ``ffmpeg``, where there is no other one.

    ns-render refuses to render without a program of that name, and pip cannot install one. The link to the binary is
    removed when the process ends. Without a binary nothing happens: ns-render says what to install.
    """
    if shutil.which("ffmpeg") is not None:
        return
    try:
        # Imported lazily, because few commands render.
        import imageio_ffmpeg

        binary = imageio_ffmpeg.get_ffmpeg_exe()
        folder = tempfile.mkdtemp(prefix="aenerf-ns-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        Path(folder, "ffmpeg").symlink_to(binary)
    # imageio-ffmpeg raises RuntimeError where it brings no binary for the machine.
    except (ImportError, RuntimeError, OSError):
        return
    os.environ["PATH"] = f"{os.environ.get('PATH', '')}{os.pathsep}{folder}"
