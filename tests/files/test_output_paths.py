"""Outputs of commands that fail."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import creating


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_what_is_unfinished_is_removed(error: type[BaseException] | BaseException, tmp_path: Path) -> None:
    def fail(output: Path, make: Callable[[Path], object]) -> None:
        with creating(output):
            make(output)
            raise error

    for make in (lambda path: path.touch(), lambda path: (path / "a").mkdir(parents=True)):
        with pytest.raises((KeyboardInterrupt, DataError)):
            fail(tmp_path / "made", make)
        assert not (tmp_path / "made").exists()


def test_what_was_there_before_stays(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("old")
    with pytest.raises(KeyboardInterrupt), creating(tmp_path / "file"):
        raise KeyboardInterrupt
    assert (tmp_path / "file").read_text() == "old"
