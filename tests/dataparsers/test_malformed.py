"""Malformed data sets of every format: one clear line each, in little memory and time."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.bounded_reading import MAX_SECONDS, little_memory, read_whole, readable_folder, without_rights_of_root
from helpers.dataset_faults import read_everything
from helpers.malformed_inputs import FORMAT_WRITERS, MALFORMED
from helpers.published_datasets import config_of

from aenerf_ns.errors import DataError

# Inputs that mean something: a time of zero, names for 0 and 1, and the pose of a train view, which is not used.
MEANINGFUL = {"timestamp of 1e-999999999", "eds enumeration", "matrix of 1e300"}
CASES = [(group, name) for group, cases in MALFORMED.items() for name in cases if name not in MEANINGFUL]


@pytest.fixture(scope="module")
def whole() -> Iterator[dict[str, Path]]:
    """A data set of each format, read once: the first reading compiles, and shows that there is nothing to refuse."""
    folders = {}
    with readable_folder() as root:
        for name, write in FORMAT_WRITERS.items():
            write(root / name)
            folders[name] = root / name
            read_whole(lambda name=name: read_everything(config_of(name, root / name)))
        yield folders


# A warning of a library would print a second line.
@pytest.mark.filterwarnings("error::RuntimeWarning", "error::UserWarning")
@pytest.mark.parametrize(("group", "name"), CASES, ids=lambda value: value.replace(" ", "_"))
def test_a_malformed_dataset_is_one_line(group: str, name: str, whole: dict[str, Path]) -> None:
    kind, change = MALFORMED[group][name]
    folder = Path(shutil.copytree(whole[kind], whole[kind].parent / "case" / "made"))
    try:
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o777)
        change(folder)
        with little_memory(), without_rights_of_root():
            begin = time.process_time()
            with pytest.raises(DataError) as error:
                read_everything(config_of(kind, folder))
            seconds = time.process_time() - begin
    finally:
        shutil.rmtree(folder.parent)
    # The refusal is of the fault.
    assert group == "rights" or "Permission denied" not in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 800
    assert seconds < MAX_SECONDS
