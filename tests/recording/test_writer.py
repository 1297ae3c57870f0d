"""Writing the native dataset format."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.small_datasets import CAMERA, SENSOR, make_trajectory, write_native
from PIL import Image

from aenerf_ns.cli.convert import Convert
from aenerf_ns.errors import DataError
from aenerf_ns.recording.writer import NativeDatasetWriter


def test_incomplete_dataset_leaves_nothing(tmp_path: Path) -> None:
    with (
        pytest.raises(ValueError, match="no trajectory"),
        NativeDatasetWriter(tmp_path / "made", CAMERA, SENSOR, "srgb"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


# Each place where bytes go to the disk. HDF5 writes into what was reserved for it.
WRITES = [(os, "posix_fallocate"), (Path, "open"), (Path, "mkdir"), (Image.Image, "save"), (shutil, "copyfile")]


def fails_at_every_write(folder: Path, write: Callable[[Path], object], monkeypatch: pytest.MonkeyPatch) -> int:
    """Let the disk be full at the first write, the second and so on, and return the number of writes."""
    opened = Path.open
    for point in range(1000):
        count = 0

        def full(original: Callable[..., Any], point: int = point) -> Callable[..., Any]:
            def call(*args: Any, **options: Any) -> Any:
                nonlocal count
                # A path and its mode; files that are read take no room.
                if original is not opened or "w" in str(args[1:2]) + str(options.get("mode")):
                    count += 1
                    if count == point + 1:
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return original(*args, **options)

            return call

        open_files = h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE)
        with monkeypatch.context() as patch:
            for owner, name in WRITES:
                patch.setattr(owner, name, full(getattr(owner, name)))
            try:
                write(folder / "made")
            except DataError as error:
                message = str(error)
            else:
                assert count == point
                return point
        assert "No space left on device" in message
        assert list(folder.iterdir()) == []
        assert h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE) == open_files
    raise AssertionError("it never ends")


def write_as_simulated(folder: Path) -> None:
    trajectory = make_trajectory()
    with NativeDatasetWriter(folder, CAMERA, SENSOR, "srgb") as writer:
        writer.add_trajectories(trajectory, trajectory)
        writer.add_poses_report({})
        picture, linear = np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6, 3), np.uint16)
        pose, depth = trajectory.camera_to_worlds[0], np.ones((4, 6), np.float32)
        for split in ("train", "val", "test"):
            writer.add_image(split, picture, pose, linear=linear, depth=depth)


def test_full_disk_leaves_nothing_of_a_simulation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert fails_at_every_write(tmp_path, write_as_simulated, monkeypatch) > 12


def test_full_disk_leaves_nothing_of_a_conversion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_native(tmp_path / "source")
    (tmp_path / "to").mkdir()
    assert fails_at_every_write(tmp_path / "to", lambda folder: Convert(source, folder).main(), monkeypatch) > 8
