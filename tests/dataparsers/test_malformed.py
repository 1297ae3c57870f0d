"""Malformed datasets of every format, and recordings that unpack to far more than they hold: one clear line each, in
little memory and time."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.bounded_reading import read_whole, readable_folder, refusal
from helpers.malformed_inputs import MALFORMED
from helpers.vendor_recordings import BOMBS, DATASETS, read_dataset

CASES = {**MALFORMED, **BOMBS}


@pytest.fixture(scope="module")
def whole() -> Iterator[Path]:
    """A dataset of each kind, read once: the first reading compiles, and shows that there is nothing to refuse."""
    pytest.importorskip("rosbags")
    with readable_folder() as root:
        for kind, write in DATASETS.items():
            write(root / kind)
            read_whole(lambda kind=kind: read_dataset(kind, root / kind))
        yield root


# A warning of a library would print a second line.
@pytest.mark.filterwarnings("error::RuntimeWarning", "error::UserWarning")
@pytest.mark.parametrize("name", sorted(CASES), ids=lambda name: name.replace(" ", "_"))
def test_malformed_dataset_is_one_line(name: str, whole: Path) -> None:
    kind, change = CASES[name]
    folder = Path(shutil.copytree(whole / kind, whole / "case" / "made"))
    try:
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o777)
        change(folder)
        message = refusal(lambda: read_dataset(kind, folder))
    finally:
        shutil.rmtree(folder.parent)
    assert message
    # The refusal is of the fault.
    assert "unreadable" in name or "Permission denied" not in message
