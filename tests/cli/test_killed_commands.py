"""Commands that are killed at any moment: what they leave is not taken for a dataset, and the next start removes it."""

from __future__ import annotations

import shutil
import time
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pytest
from helpers.small_datasets import write_native

from aenerf_ns.cli.convert import Convert
from aenerf_ns.cli.simulate import Simulate
from aenerf_ns.dataparsers.native import NativeDataParserConfig

NUM_MOMENTS = 20

# The server imports once, and each command runs in a copy of it.
_SERVER = get_context("forkserver")
_SERVER.set_forkserver_preload(
    ["aenerf_ns.dataparsers.formats", "aenerf_ns.recording.writer", "aenerf_ns.simulator.simulation"]
)


def run(command: Convert | Simulate) -> None:
    """Run a command, with light at few points where it simulates."""
    from aenerf_ns.simulator.rendering import mesh_repair

    mesh_repair.NUM_CORNERS = 2000
    command.main()


def started(command: Convert | Simulate) -> BaseProcess:
    process = _SERVER.Process(target=run, args=(command,))
    process.start()
    return process


def finish(command: Convert | Simulate) -> None:
    process = started(command)
    process.join()
    assert process.exitcode == 0


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["convert", "simulate"])
def test_killed_command_leaves_nothing(name: str, tmp_path: Path) -> None:
    data = write_native(tmp_path / "data")
    folder = tmp_path / "outputs"
    output = folder / "made"
    command: Convert | Simulate = Convert(data=data, output=output)
    if name == "simulate":
        views = {"train_images": 2, "validation_views": 1, "test_views": 1}
        command = Simulate(output=output, scene="object", width=32, height=24, duration=0.2, **views)
    # Once for what is compiled and cached.
    finish(command)
    whole = contents(output)
    shutil.rmtree(output)
    begin = time.perf_counter()
    finish(command)
    seconds = time.perf_counter() - begin
    shutil.rmtree(output)
    completed = partial = 0
    for moment in np.linspace(0, 1.2 * seconds, NUM_MOMENTS):
        process = started(command)
        time.sleep(moment)
        process.kill()
        process.join()
        completed += output.exists()
        partial += (folder / ".made.partial").exists()
        if not output.exists():
            finish(command)
        assert contents(output) == whole
        assert list(folder.iterdir()) == [output]
        NativeDataParserConfig(data=output).setup().read_recording()
        shutil.rmtree(output)
    assert 0 < completed < NUM_MOMENTS
    assert partial > 0
