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
    """Machine, versions, commit (None outside a checkout) and command of this process."""
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
    git = ("git", "-C", str(Path(__file__).parent))
    commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    if commit.returncode:
        return None
    changed = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=False)
    return commit.stdout.strip() + ("+changes" if changed.stdout.strip() else "")


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
