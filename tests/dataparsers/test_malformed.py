"""Malformed data sets of every format: one clear line each, in little memory and time."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import pytest
from bounded_reading import MAX_SECONDS, little_memory, without_rights_of_root
from dataset_faults import read_everything
from malformed_inputs import FORMAT_WRITERS, MALFORMED
from published_datasets import config_of

from aenerf_ns.errors import DataError

# Inputs that mean something: a time of zero, and names for 0 and 1.
MEANINGFUL = {"timestamp of 1e-999999999", "eds enumeration"}
CASES = [(group, name) for group, cases in MALFORMED.items() for name in cases if name not in MEANINGFUL]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A data set of each format, read once: the first reading compiles."""
    root = tmp_path_factory.mktemp("whole")
    root.chmod(0o777)
    root.parent.chmod(0o777)
    folders = {}
    for name, write in FORMAT_WRITERS.items():
        write(root / name)
        folders[name] = root / name
        read_everything(config_of(name, root / name))
    return folders


@pytest.mark.parametrize(("group", "name"), CASES, ids=lambda value: value.replace(" ", "_"))
def test_a_malformed_dataset_is_one_line(group: str, name: str, whole: dict[str, Path], tmp_path: Path) -> None:
    kind, change = MALFORMED[group][name]
    folder = Path(shutil.copytree(whole[kind], whole[kind].parent / "case" / "made"))
    try:
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o777)
        change(folder)
        with little_memory(), without_rights_of_root():
            begin = time.perf_counter()
            with pytest.raises(DataError) as error:
                read_everything(config_of(kind, folder))
            seconds = time.perf_counter() - begin
    finally:
        shutil.rmtree(folder.parent)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 800
    assert seconds < MAX_SECONDS
