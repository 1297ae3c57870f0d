"""Writing the native dataset format."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_datasets import (
    CAMERA,
    SENSOR,
    write_native,
)

from aenerf_ns.errors import DataError
from aenerf_ns.recording.writer import NativeDatasetWriter


def test_nothing_is_left_of_a_dataset_that_could_not_be_completed(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), NativeDatasetWriter(tmp_path / "made", CAMERA, SENSOR, "srgb"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with (
        pytest.raises(ValueError, match="no trajectory"),
        NativeDatasetWriter(tmp_path / "made", CAMERA, SENSOR, "srgb"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
    write_native(tmp_path / "made")
    with pytest.raises(DataError, match="made: the folder exists already"):
        NativeDatasetWriter(tmp_path / "made", CAMERA, SENSOR, "srgb")
