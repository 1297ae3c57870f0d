"""One command at a time for an output."""

import errno
import os
from pathlib import Path

import pytest
from filelock import FileLock
from helpers.small_datasets import CAMERA, SENSOR, write_native

from aenerf_ns.errors import DataError
from aenerf_ns.recording.output_lock import OutputLock
from aenerf_ns.recording.writer import NativeDatasetWriter


def test_second_is_refused_while_the_first_lives(tmp_path: Path) -> None:
    output, lock = tmp_path / "made", tmp_path / ".made.partial.lock"
    in_use = tmp_path / ".made.partial" / "events.h5"
    in_use.parent.mkdir()
    in_use.write_text("half written")
    # The lock is of its own descriptor, so another one in the same process is another owner.
    owner = OutputLock(output)
    message = rf"made: another command is writing it \(process {os.getpid()} on .*\); wait"
    for attempt in (lambda: OutputLock(output), lambda: NativeDatasetWriter(output, CAMERA, SENSOR, "srgb")):
        with pytest.raises(DataError, match=message):
            attempt()
    assert in_use.read_text() == "half written"
    owner.release()
    # The file of a lock whose owner was killed does not stop the next command.
    lock.write_text("process 7 on elsewhere")
    write_native(output)
    assert (output / "transforms.json").exists()
    assert list(tmp_path.iterdir()) == [output]


def test_writer_uses_the_lock_of_its_caller(tmp_path: Path) -> None:
    with OutputLock(tmp_path / "made") as lock:
        with pytest.raises(RuntimeError), NativeDatasetWriter(lock, CAMERA, SENSOR, "srgb"):
            raise RuntimeError
        # Still held.
        with pytest.raises(DataError, match="another command is writing it"):
            OutputLock(tmp_path / "made")
        # Made, and never entered, as where an interrupt comes.
        NativeDatasetWriter(lock, CAMERA, SENSOR, "srgb")
        assert (tmp_path / ".made.partial" / "events.h5").exists()
    assert not list(tmp_path.iterdir())


def test_output_finished_meanwhile_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    acquire = FileLock.acquire

    def late(lock: FileLock, **options: bool) -> object:
        (tmp_path / "made").mkdir()
        return acquire(lock, **options)

    monkeypatch.setattr(FileLock, "acquire", late)
    with pytest.raises(DataError, match="the folder exists already"):
        OutputLock(tmp_path / "made")
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_file_system_without_locks_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def none(*_: object, **__: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(FileLock, "acquire", none)
    write_native(tmp_path / "[made]")
    warning = "[made]: its file system has no locks (No locks available): start no second command"
    assert warning in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [tmp_path / "[made]"]


def test_uncreatable_output_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for name in ("file/made", "a" * 250):
        with pytest.raises(DataError, match=r"it cannot be created \(.*\); choose another --output"):
            OutputLock(tmp_path / name)
