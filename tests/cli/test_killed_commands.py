"""A command that is killed at any moment: what it leaves is no dataset, and the next start removes it."""

from __future__ import annotations

import shutil
import time
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from helpers.small_datasets import write_native

from aenerf_ns.cli.convert import Convert
from aenerf_ns.dataparsers.native import NativeDataParserConfig

NUM_MOMENTS = 20

# The server imports once, and each command runs in a copy of it.
_SERVER = get_context("forkserver")
_SERVER.set_forkserver_preload(["aenerf_ns.dataparsers.formats", "aenerf_ns.recording.writer"])


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_killed_command_leaves_nothing(tmp_path: Path) -> None:
    output = tmp_path / "outputs" / "made"
    command = Convert(write_native(tmp_path / "data"), output)

    def run(kill_after: float | None = None) -> None:
        process = _SERVER.Process(target=command.main)
        process.start()
        if kill_after is not None:
            time.sleep(kill_after)
            process.kill()
        process.join()
        assert kill_after is not None or process.exitcode == 0

    # Once for what is compiled and cached.
    run()
    whole = contents(output)
    shutil.rmtree(output)
    begin = time.perf_counter()
    run()
    seconds = time.perf_counter() - begin
    shutil.rmtree(output)
    completed = partial = 0
    for moment in np.linspace(0, 1.2 * seconds, NUM_MOMENTS):
        run(kill_after=moment)
        completed += output.exists()
        partial += output.with_name(".made.partial").exists()
        if not output.exists():
            run()
        assert contents(output) == whole
        assert list(output.parent.iterdir()) == [output]
        NativeDataParserConfig(data=output).setup().read_recording()
        shutil.rmtree(output)
    assert 0 < completed < NUM_MOMENTS
    assert partial > 0
