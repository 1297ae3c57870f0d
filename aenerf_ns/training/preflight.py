"""Checks before a command begins: its device, and the program and the camera path that ns-render needs."""

from __future__ import annotations

import argparse
import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import torch

from aenerf_ns.errors import DataError
from aenerf_ns.files.json_file import read_json


class _Camera(msgspec.Struct):
    camera_to_world: list[Any]
    fov: float | None = None

    def __post_init__(self) -> None:
        if np.asarray(self.camera_to_world, np.float64).size != 16:
            raise ValueError("camera_to_world does not have 16 numbers")


class _CameraPath(msgspec.Struct):
    """The fields that ns-render reads. It does not check that the file has them."""

    seconds: Annotated[float, msgspec.Meta(gt=0)]
    render_width: Annotated[float, msgspec.Meta(ge=1)]
    render_height: Annotated[float, msgspec.Meta(ge=1)]
    camera_path: Annotated[list[_Camera], msgspec.Meta(min_length=1)]
    camera_type: str = "perspective"

    def __post_init__(self) -> None:
        is_panorama = self.camera_type.lower() in ("equirectangular", "omnidirectional", "vr180")
        if not is_panorama and any(camera.fov is None for camera in self.camera_path):
            raise ValueError("a camera has no field of view `fov`")


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


def require_camera_path() -> None:
    """Raise a DataError if this process is ``ns-render camera-path`` and the file of the path lacks what it needs."""
    if Path(sys.argv[0]).name != "ns-render" or "camera-path" not in sys.argv[1:2]:
        return
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("--camera-path-filename", "--camera_path_filename", type=Path, default="camera_path.json")
    path = parser.parse_known_args(sys.argv[2:])[0].camera_path_filename
    read_json(path, _CameraPath, "export the camera path from the viewer's Render tab")
