"""The file of pairs beside a long recording: found again, made again, never trusted when it is broken."""

import fcntl
import os
import socket
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.small_datasets import parse, write_native
from helpers.streams import assert_same_pairs

from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events import pairing
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_hdf5 import Hdf5EventFile
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.pair_cache import PairFile
from aenerf_ns.supervision.event_pairs import PairLossCoefficients, PairSamplerConfig, PairSupervisionConfig

KEPT = "events.h5.pairs"
PART = f"{KEPT}.{socket.gethostname()}.part"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_native(tmp_path / "made[/i]")


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The event files that were read, one entry for each time."""
    read: list[Path] = []
    original = Hdf5EventFile.read_chunks

    def counted(self: Hdf5EventFile) -> Iterator[EventStream]:
        read.append(self.path)
        for chunk in original(self):
            yield from (chunk[begin : begin + 30] for begin in range(0, len(chunk), 30))

    monkeypatch.setattr(Hdf5EventFile, "read_chunks", counted)
    return read


@pytest.fixture
def long_recording(monkeypatch: pytest.MonkeyPatch, reads: list[Path]) -> list[Path]:
    """Recordings of 200 events are too long for memory."""
    original = pairing.pair_events
    monkeypatch.setattr(
        pairing, "pair_events", lambda *args, **options: original(*args, **options, events_in_memory=50)
    )
    monkeypatch.setattr(pairing, "_ROWS_AT_A_TIME", 20)
    return reads


def opened(folder: Path, **options: int) -> EventDataset:
    return EventDataset(parse(NativeDataParserConfig(data=folder, **options)))


def test_pairs_in_file_equal_those_in_memory(data: Path, reads: list[Path], request: pytest.FixtureRequest) -> None:
    in_memory = opened(data)
    assert len(in_memory.pairs) > 100
    assert not (data / KEPT).exists()
    request.getfixturevalue("long_recording")
    made, found = opened(data), opened(data)
    assert_same_pairs(made.pairs, in_memory.pairs)
    assert sorted(path.name for path in data.glob("events*")) == ["events.h5", KEPT]
    assert len(reads) == 2
    assert_same_pairs(found.pairs, in_memory.pairs)
    for camera in range(len(made)):
        assert np.array_equal(found.get_numpy_image(camera), in_memory.get_numpy_image(camera))
    assert len(reads) == 2
    batches = []
    for dataset in (in_memory, found):
        losses = PairLossCoefficients(temporal_loss=1.0)
        supervision = PairSupervisionConfig().setup(sensor=dataset.scene.sensor, loss_coefficients=losses)
        sampler = PairSamplerConfig().setup(dataset=dataset, supervision=supervision, device="cpu")
        torch.manual_seed(3)
        batches.append(sampler.sample(300))
    (rays, batch), (mapped_rays, mapped_batch) = batches
    assert torch.equal(rays.times, mapped_rays.times)
    assert torch.equal(rays.directions, mapped_rays.directions)
    assert all(torch.equal(value, vars(mapped_batch)[name]) for name, value in vars(batch).items())


def test_changed_events_or_options_make_new_pairs(
    data: Path, long_recording: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    whole = len(opened(data).pairs)
    start = opened(data).scene.window.start + 500_000_000
    assert len(opened(data, start_time_ns=start).pairs) < whole
    printed = " ".join(capsys.readouterr().out.split())
    assert "events.h5.pairs is of other events or options: it is made again." in printed
    assert len(long_recording) == 2
    assert len(opened(data, start_time_ns=start).pairs) < whole
    assert len(long_recording) == 2
    time = (data / "events.h5").stat().st_mtime_ns + 1
    os.utime(data / "events.h5", ns=(time, time))
    _ = opened(data, start_time_ns=start).pairs
    assert len(long_recording) == 3


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[:-1],
        lambda content: content[:5],
        lambda content: b"",
        lambda content: b"x" * 5000,
        lambda content: content[16:],
        lambda content: content.replace(b"num_first", b"num_last_"),
        # The last byte of the rows and of each part of the archive but one.
        lambda content: content.replace(b"\0PK\3\4", b"\1PK\3\4"),
    ],
)
def test_broken_file_is_made_again(
    data: Path, long_recording: list[Path], damage: Callable[[bytes], bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    pairs = opened(data).pairs
    content = (data / KEPT).read_bytes()
    # Another file of this name, because the pairs are mapped from the old one.
    (data / KEPT).unlink()
    (data / KEPT).write_bytes(damage(content))
    capsys.readouterr()
    assert_same_pairs(opened(data).pairs, pairs)
    assert "events.h5.pairs is not whole" in " ".join(capsys.readouterr().out.split())
    assert len(long_recording) == 2
    assert (data / KEPT).read_bytes() == content


def test_interrupt_leaves_no_file(data: Path, long_recording: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    # As if an earlier process had been killed.
    (data / PART).write_bytes(b"half")
    read = Hdf5EventFile.read_chunks

    def fail(self: Hdf5EventFile) -> Iterator[EventStream]:
        yield from islice(read(self), 5)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Hdf5EventFile, "read_chunks", fail)
        with pytest.raises(KeyboardInterrupt):
            _ = opened(data).pairs
    assert [path.name for path in data.glob("events*")] == ["events.h5"]
    assert len(opened(data).pairs) > 100
    assert sorted(path.name for path in data.glob("events*")) == ["events.h5", KEPT]


def test_full_disk_is_one_line(data: Path, long_recording: list[Path]) -> None:
    (data / PART).symlink_to("/dev/full")
    with pytest.raises(DataError, match=r"events\.h5\.pairs: the disk is full; free some of it"):
        _ = opened(data).pairs
    assert [path.name for path in data.glob("events*")] == ["events.h5"]


def test_hosts_do_not_share_a_file(data: Path, long_recording: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    # As on a network folder.
    monkeypatch.setattr(fcntl, "flock", lambda *_: None)
    read, others = Hdf5EventFile.read_chunks, []

    def met(self: Hdf5EventFile) -> Iterator[EventStream]:
        chunks = read(self)
        yield from islice(chunks, 5)
        with monkeypatch.context() as patch:
            patch.setattr(Hdf5EventFile, "read_chunks", read)
            patch.setattr(socket, "gethostname", lambda: "other")
            others.append((opened(data).pairs, (data / KEPT).stat().st_ino))
        yield from chunks

    monkeypatch.setattr(Hdf5EventFile, "read_chunks", met)
    with monkeypatch.context() as patch:
        patch.setattr(PairFile, "_read", lambda *_: pytest.fail("the other host's file is read"))
        pairs = opened(data).pairs
    ((other, inode),) = others
    assert_same_pairs(pairs, other)
    assert (data / KEPT).stat().st_ino == inode
    assert sorted(path.name for path in data.glob("events*")) == ["events.h5", KEPT]


def test_unwritable_folder_is_left_alone(
    data: Path, long_recording: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    original, open_descriptor = Path.open, os.open

    def unlisted(path: Path, *args: int) -> int:
        if path == data:
            raise PermissionError(13, "Permission denied")
        return open_descriptor(path, *args)

    def refused(self: Path, mode: str = "r", *args: object, **options: object) -> object:
        if self.parent == data and mode != "rb" and "w" in mode:
            raise PermissionError(13, "Permission denied")
        return original(self, mode, *args, **options)

    monkeypatch.setattr(Path, "open", refused)
    monkeypatch.setattr(os, "open", unlisted)
    first = opened(data).pairs
    out = " ".join(capsys.readouterr().out.split())
    assert "cannot be written to (Permission denied): the pairs are in" in out
    assert [path.name for path in data.glob("events*")] == ["events.h5"]
    assert_same_pairs(opened(data).pairs, first)
    assert len(long_recording) == 2


def test_short_recording_removes_the_file(
    data: Path, long_recording: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    start = opened(data).scene.window.start + 10**9
    _ = opened(data).pairs
    assert (data / KEPT).exists()
    monkeypatch.undo()
    assert len(opened(data, start_time_ns=start).pairs) > 0
    assert not (data / KEPT).exists()
