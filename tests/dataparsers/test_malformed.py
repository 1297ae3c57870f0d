"""Malformed data sets of every format: one clear line each, in little memory and time."""

from __future__ import annotations

import os
import resource
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from dataset_faults import read_everything
from malformed_inputs import FORMAT_WRITERS, MALFORMED
from published_datasets import config_of

from aenerf_ns.errors import DataError

# What a refusal may take, above what the process has.
MAX_BYTES, MAX_SECONDS = 1 << 30, 2.0
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


@contextmanager
def little_memory() -> Iterator[None]:
    """Let the process have 1 GB more than it has."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + MAX_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@contextmanager
def without_rights_of_root() -> Iterator[None]:
    """Root may read everything."""
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)


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
