"""The format of PAEv3D."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.dataset_faults import assert_one_clear_line, remove, write_text
from helpers.published_datasets import (
    config_of,
    recording_of,
    write_paev3d,
)

from aenerf_ns.dataparsers.formats import recognize
from aenerf_ns.dataparsers.paev3d import PAEv3DDataParserConfig
from aenerf_ns.errors import DataError


def test_poses_of_paev3d_run_no_code(tmp_path: Path) -> None:
    truth = write_paev3d(tmp_path / "made")
    file = truth.data / "Render_info" / "Bunny" / "0003.npz"

    class Harm:
        def __reduce__(self) -> tuple:
            return os.mkdir, (str(tmp_path / "harm"),)

    np.savez(file, object_poses=np.array([Harm()], dtype=object))
    with pytest.raises(DataError, match=r"0003.npz: not a readable array object_poses .it asks for posix.mkdir"):
        recording_of(PAEv3DDataParserConfig(data=truth.data))
    assert not (tmp_path / "harm").exists()


def test_scenes_of_paev3d_are_told_apart(tmp_path: Path) -> None:
    truth = write_paev3d(tmp_path / "made")
    for part in ("H5_Files", "Render_info"):
        shutil.copytree(truth.data / part / "Bunny", truth.data / part / "Car")
    with pytest.raises(DataError, match=r"it holds 2 scenes; give one as --data, such as .*H5_Files/Bunny"):
        recording_of(PAEv3DDataParserConfig(data=truth.data))
    one = truth.data / "H5_Files" / "Car"
    assert recognize(one) == "paev3d-data"
    assert recording_of(PAEv3DDataParserConfig(data=one)).event_file.path.parent == one


FAULTS = {
    "no events": (remove("H5_Files/Bunny/*"), "event.h5: there is no such file"),
    "no poses": (remove("Render_info/Bunny/*.npz"), "Render_info/Bunny: it holds no .npz file"),
    "no intrinsics": (remove("Intrinsics/*"), "Intrinsics: it holds no .txt file"),
    "no camera": (
        lambda folder: np.savez(folder / "Render_info/Bunny/0002.npz", object_poses=[{"name": "Bunny"}]),
        "0002.npz: its object_poses hold no 'Camera'",
    ),
    "no pose": (
        lambda folder: np.savez(folder / "Render_info/Bunny/0002.npz", object_poses=[{"name": "Camera"}]),
        "0002.npz: its camera's pose is not an array of 4 x 4 numbers",
    ),
    "no object_poses": (
        lambda folder: np.savez(folder / "Render_info/Bunny/0002.npz", depth=np.zeros(3)),
        "0002.npz: it has no array object_poses",
    ),
    "text": (write_text("Render_info/Bunny/0002.npz", "pose"), "0002.npz: not a readable .npz file"),
    "lost image": (remove("Render_info/Bunny/00003.png"), "it holds 20 images for 21 poses"),
    "columns": (
        lambda folder: (
            remove("H5_Files/Bunny/*")(folder),
            h5py.File(folder / "H5_Files/Bunny/event.h5", "w").create_dataset("events", data=np.zeros((9, 3))),
        ),
        "event.h5: events has 3 columns; column 3 must hold p",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_malformed_datasets_are_one_clear_line(fault: str, tmp_path: Path) -> None:
    change, message = FAULTS[fault]
    config = config_of("paev3d-data", write_paev3d(tmp_path / "made").data)
    assert_one_clear_line(change, message, config)
