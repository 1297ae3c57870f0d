"""Where a figure was made: machine, versions, commit and command."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

_PACKAGES = (
    "aenerf-ns", "nerfstudio", "torch", "numpy", "numba", "scipy", "open3d", "opencv-contrib-python-headless", "pillow",
    "h5py", "pycolmap",
)  # fmt: skip
"""Whatever decides the bytes of a simulated dataset, and what is trained with."""


def environment() -> dict[str, Any]:
    """Machine, versions, commit (None where this is no checkout, or without git) and command of this process."""
    import torch

    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    return {
        "machine": {"cpu": _cpu(), "cores": os.cpu_count(), "gpu": gpu, "torch_threads": torch.get_num_threads()},
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in _PACKAGES},
        },
        "commit": _commit(),
        "command": " ".join([_program(), *map(_portable, sys.argv[1:])]),
    }


def _commit() -> str | None:
    def git(*arguments: str) -> str:
        command = ("git", "-C", str(Path(__file__).parent), *arguments)
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        # An installed package may lie within the checkout of something else.
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("rev-parse", "--short", "HEAD") + ("+changes" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def _program() -> str:
    """The console script or the script that runs."""
    program = Path(sys.argv[0])
    return program.name if program.is_absolute() else f"python {program}"


def _portable(argument: str) -> str:
    """An argument without the folders of this machine."""
    path = Path(argument)
    return str(Path("...", *path.parts[-3:])) if path.is_absolute() else argument


def _cpu() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()
