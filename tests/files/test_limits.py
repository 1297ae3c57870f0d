"""The limits within which files are read."""

import resource
from pathlib import Path

import pytest

from aenerf_ns.errors import DataError
from aenerf_ns.files import limits
from aenerf_ns.files.limits import bounded, bounded_items, list_files

LIMITS = (resource.RLIMIT_DATA, resource.RLIMIT_FSIZE)


def allocate(path: Path) -> object:
    return bytearray(1 << 30)


def write(path: Path) -> object:
    with (path.parent / "copy").open("wb") as file:
        for _ in range(40):
            file.write(bytes(1 << 23))
    return None


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (allocate, "far more memory"),
        (write, "not a readable thing .File too large"),
        (lambda path: {}["key"], "not a readable thing .'key'"),
        (lambda path: (path.parent / "none").read_bytes(), "none: there is no such file"),
    ],
)
def test_failure_is_one_line_and_ends_limits(read: object, message: str, tmp_path: Path) -> None:
    path = tmp_path / "small"
    path.write_text("x")
    before = [resource.getrlimit(kind) for kind in LIMITS]
    with pytest.raises(DataError, match=message), bounded(path, "thing"):
        read(path)  # type: ignore[operator]
    assert [resource.getrlimit(kind) for kind in LIMITS] == before


def test_memory_that_others_hold_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "small"
    path.write_text("x")
    (tmp_path / "meminfo").write_text("MemAvailable:   1024 kB")
    monkeypatch.setattr(limits, "_MEMORY", tmp_path / "meminfo")
    with pytest.raises(DataError, match="more memory than the 1,048,576 bytes that are free; end"), bounded(path, "x"):
        allocate(path)


def test_limits_hold_while_an_item_is_read(tmp_path: Path) -> None:
    path = tmp_path / "small"
    path.write_text("x")
    before = resource.getrlimit(resource.RLIMIT_DATA)
    inside = []
    items = (inside.append(resource.getrlimit(resource.RLIMIT_DATA)) or i for i in range(2))
    for _ in bounded_items(items, path, "thing"):
        assert resource.getrlimit(resource.RLIMIT_DATA) == before
    assert len(inside) == 2
    assert before not in inside


def test_files_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    stamps = ["t1700000000000000001.png", "t1700000000000000002.png"]
    names = ["0.15.png", "0.2.png", "r_9.png", "r_10.png", "r_100.png", *stamps]
    for name in reversed(names):
        (tmp_path / name).touch()
    assert [file.name for file in list_files(tmp_path, "*.png")] == names
