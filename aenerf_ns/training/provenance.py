"""Where a figure was made: machine, versions, commit and command."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = (
    "aenerf-ns", "nerfstudio", "torch", "numpy", "numba", "scipy", "open3d", "opencv-contrib-python-headless", "pillow",
    "h5py", "pycolmap",
)  # fmt: skip
"""The packages that a training uses, or that the bytes of a simulated dataset depend on."""


def provenance() -> dict[str, Any]:
    """Return the machine, the versions, the commit and the command of this process.

    The commit is None outside a checkout of this project, or without git. It ends in ``+changes`` where files differ
    from the commit.
    """
    import torch

    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    return {
        "machine": {"cpu": _cpu(), "cores": os.cpu_count(), "gpu": gpu, "torch_threads": torch.get_num_threads()},
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in _PACKAGES}},
        "commit": _commit(),
        "command": " ".join([_program(), *map(_portable, sys.argv[1:])]),
    }


def _version(name: str) -> str | None:
    """Return the version of a package, None where another distribution brings its module."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    def git(*arguments: str) -> str:
        command = ("git", "-C", str(Path(__file__).parent), *arguments)
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        # An unpacked copy of this project may lie within the checkout of another one.
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("rev-parse", "--short", "HEAD") + ("+changes" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def _program() -> str:
    """Return how this process was started: ``python -m MODULE``, or the name of a script."""
    spec = sys.modules["__main__"].__spec__
    return Path(sys.argv[0]).name if spec is None else f"python -m {spec.name.removesuffix('.__main__')}"


def _portable(argument: str) -> str:
    """Return an argument, which may begin with ``NAME=``, without the folders of this machine."""
    name, path = re.fullmatch(r"([^/=]*=)?(.*)", argument, re.DOTALL).groups("")  # type: ignore[union-attr]
    return name + (str(Path("...", *Path(path).parts[1:][-3:])) if path.startswith("/") else path)


def _cpu() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()
