"""Recordings of every vendor's format that state or unpack to far more than they hold: one line, quickly."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.bounded_reading import MAX_SECONDS, little_memory, readable_folder
from helpers.dataset_faults import read_everything
from helpers.vendor_recordings import BOMBS, RECORDINGS, config_of_recording

from aenerf_ns.errors import DataError


@pytest.fixture(scope="module")
def whole() -> Iterator[dict[str, Path]]:
    """A recording of each kind, read once: the first reading compiles, and shows that there is nothing to refuse."""
    pytest.importorskip("rosbags")
    with readable_folder() as root:
        folders = {name: root / name.replace(" ", "_") for name in RECORDINGS}
        for name, folder in folders.items():
            RECORDINGS[name](folder)
            read_everything(config_of_recording(folder))
        yield folders


@pytest.mark.parametrize("name", BOMBS, ids=lambda name: name.replace(" ", "_"))
def test_a_bomb_is_one_line(name: str, whole: dict[str, Path]) -> None:
    kind, change = BOMBS[name]
    folder = Path(shutil.copytree(whole[kind], whole[kind].parent / "case"))
    try:
        change(folder)
        with little_memory():
            begin = time.process_time()
            with pytest.raises(DataError) as error:
                read_everything(config_of_recording(folder))
            seconds = time.process_time() - begin
    finally:
        shutil.rmtree(folder)
    print(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 800
    assert seconds < MAX_SECONDS
