"""The format of PAEv3D."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.published_datasets import recording_of, write_paev3d

from aenerf_ns.dataparsers.formats import recognize
from aenerf_ns.dataparsers.paev3d import PAEv3DDataParserConfig
from aenerf_ns.errors import DataError


def test_poses_run_no_code(tmp_path: Path) -> None:
    truth = write_paev3d(tmp_path / "made")
    file = truth.data / "Render_info" / "Bunny" / "0003.npz"

    class Harm:
        def __reduce__(self) -> tuple:
            return os.mkdir, (str(tmp_path / "harm"),)

    np.savez(file, object_poses=np.array([Harm()], dtype=object))
    with pytest.raises(DataError, match=r"0003.npz: not a readable array object_poses .it asks for posix.mkdir"):
        recording_of(PAEv3DDataParserConfig(data=truth.data))
    assert not (tmp_path / "harm").exists()


def test_choose_one_of_several_scenes(tmp_path: Path) -> None:
    truth = write_paev3d(tmp_path / "made")
    for part in ("H5_Files", "Render_info"):
        shutil.copytree(truth.data / part / "Bunny", truth.data / part / "Car")
    with pytest.raises(DataError, match=r"it holds 2 scenes .*H5_Files/Bunny"):
        recording_of(PAEv3DDataParserConfig(data=truth.data))
    one = truth.data / "H5_Files" / "Car"
    assert recognize(one) == "paev3d-data"
    assert recording_of(PAEv3DDataParserConfig(data=one)).event_file.path.parent == one
