"""Running the real commands, for the tests that do."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import tyro

from aenerf_ns.cli.simulate import Simulate
from aenerf_ns.simulator import locomotive, room, shapes, simulation

CPU = ("--machine.device-type", "cpu")
TIMEOUT = 1200
"""Seconds after which a command hangs. No test rests on it, and a slow machine may need long."""


def run(*command: str | Path, cwd: Path, gpu: bool = False) -> str:
    """Runs a console script of this environment and returns its output, without terminal formatting."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
    if not gpu:
        environment["CUDA_VISIBLE_DEVICES"] = ""
    script = Path(sys.executable).parent / str(command[0])
    done = subprocess.run(
        [script, *command[1:]], cwd=cwd, env=environment, capture_output=True, text=True, timeout=TIMEOUT, check=False
    )
    output = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", done.stdout + done.stderr)
    assert done.returncode == 0, output[-3000:]
    return output


def simulate(folder: Path, *options: str) -> Path:
    """Simulates a small recording in this process, for tests in which exact events do not matter.

    It has few frames, seen by few rays, in light that is computed at few points.
    """
    size = ("--width", "48", "--height", "36", "--train-images", "4", "--validation-views", "4", "--test-views", "3")
    with pytest.MonkeyPatch.context() as patch:
        for scene in (room, locomotive):
            patch.setattr(scene, "mesh_of", lambda *args, spacing, **gloss: shapes.mesh_of(*args, 4 * spacing, **gloss))
        patch.setattr(simulation, "RAYS_PER_PIXEL", 4)
        tyro.cli(Simulate, args=["--output", str(folder), "--max-displacement", "2", *size, *options]).main()
    return folder


def newest_config(folder: Path) -> Path:
    return max(folder.rglob("config.yml"), key=lambda path: path.stat().st_mtime)
