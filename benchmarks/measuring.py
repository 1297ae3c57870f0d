"""What every benchmark records about where it ran."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import torch


def environment() -> dict:
    """Machine, versions, commit and command of this run."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    changed = subprocess.run(["git", "status", "--porcelain"], capture_output=True, text=True, check=False)
    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    return {
        "machine": {"cpu": _cpu(), "cores": os.cpu_count(), "gpu": gpu, "torch_threads": torch.get_num_threads()},
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("aenerf-ns", "nerfstudio", "torch", "numpy", "numba")},
        },
        "commit": commit.stdout.strip() + ("+changes" if changed.stdout.strip() else ""),
        "command": " ".join(["python", *map(_portable, sys.argv)]),
    }


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
