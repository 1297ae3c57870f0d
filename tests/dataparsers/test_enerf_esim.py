"""E-NeRF's ESIM scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.dataset_faults import assert_one_clear_line, remove, write_text
from helpers.published_datasets import (
    config_of,
    write_enerf_esim,
)

FAULTS = {
    "no events": (remove("events"), "events: there is no such folder of events"),
    "empty folder": (remove("events/*"), "events: it holds no .npy file"),
    "no camera": (remove("poses_bounds.npy"), "poses_bounds.npy: there is no such file"),
    "two lists": (write_text("other_poses_all.txt", ""), r"it holds 2 files \*poses_all\*.txt"),
    "small bounds": (
        lambda folder: np.save(folder / "poses_bounds.npy", np.zeros((12, 4))),
        r"poses_bounds.npy: it has type float64 and shape \(12, 4\)",
    ),
    "empty bounds": (
        lambda folder: np.save(folder / "poses_bounds.npy", np.zeros((12, 17))),
        "width must be a whole number from 1",
    ),
    "NaN bounds": (
        lambda folder: np.save(folder / "poses_bounds.npy", np.full((12, 17), np.nan)),
        "poses_bounds.npy: width must be a whole number",
    ),
    "unsorted files": (lambda folder: (folder / "events/2.npy").rename(folder / "events/20.npy"), "sort the ev"),
    "text": (write_text("events/2.npy", "x y t p"), "2.npy: not a readable .npy file"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_malformed_datasets_are_one_clear_line(fault: str, tmp_path: Path) -> None:
    change, message = FAULTS[fault]
    config = config_of("enerf-esim-data", write_enerf_esim(tmp_path / "made").data)
    assert_one_clear_line(change, message, config)
