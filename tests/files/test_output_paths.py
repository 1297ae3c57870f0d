"""Outputs of commands that fail."""

from collections.abc import Callable
from pathlib import Path

import pytest

from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import creating


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_what_is_unfinished_is_removed(error: type[BaseException] | BaseException, tmp_path: Path) -> None:
    def fail(output: Path, make: Callable[[Path], object]) -> None:
        with creating(output) as partial:
            make(partial)
            raise error

    for make in (lambda path: path.touch(), lambda path: (path / "a").mkdir(parents=True)):
        with pytest.raises((KeyboardInterrupt, DataError)):
            fail(tmp_path / "made", make)
        assert not list(tmp_path.iterdir())


def test_an_older_file_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_text("old")
    link.symlink_to(file)

    def write(error: BaseException | None) -> None:
        with creating(link) as partial:
            partial.write_text("new")
            if error is not None:
                raise error

    with pytest.raises(KeyboardInterrupt):
        write(KeyboardInterrupt())
    assert file.read_text() == "old"
    write(None)
    assert file.read_text() == "new"
    assert sorted(tmp_path.iterdir()) == [file, link]
