"""The measures and the table of the benchmark of the correction of poses."""

import json
import math
from pathlib import Path

import pytest
import torch

from aenerf_ns.camera.rotation import motion_from_twist
from aenerf_ns.errors import DataError
from benchmarks.paper.running import Run, Runner
from benchmarks.poses.__main__ import Poses, pixel_errors, table

_CAMERA = {"fx": 100.0, "fy": 100.0, "width": 100.0, "height": 80.0, "depth": 2.0}


def _poses(count: int = 41) -> torch.Tensor:
    """Return poses that slide along x by 0.5 in 4 seconds, while they bob."""
    poses = torch.eye(4, dtype=torch.float64)[:3].repeat(count, 1, 1)
    along = torch.linspace(0, 1, count, dtype=torch.float64)
    poses[:, 0, 3], poses[:, 1, 3] = 0.5 * along, 0.1 * torch.sin(12 * along)
    return poses


def test_shared_error_is_none() -> None:
    poses = _poses()
    shared = torch.eye(4, dtype=torch.float64)
    shared[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    seconds = torch.linspace(0, 4, len(poses), dtype=torch.float64)
    errors = pixel_errors(
        (shared @ torch.cat([poses, shared[3:].expand(len(poses), 1, 4)], 1))[:, :3], poses, seconds, _CAMERA
    )
    assert max(errors.values()) < 1e-6


def test_turn_in_pixels() -> None:
    poses = _poses()
    wrong = poses.clone()
    # Every second pose, 0.1 seconds from its neighbors, is turned by 0.01 radians.
    turn = motion_from_twist(torch.tensor([0.0, 0, 0, 0, 0.01, 0], dtype=torch.float64))
    wrong[1::2, :, :3] = wrong[1::2, :, :3] @ turn[:3, :3]
    seconds = torch.linspace(0, 4, len(poses), dtype=torch.float64)
    errors = pixel_errors(wrong, poses, seconds, _CAMERA)
    # A pixel, 100 x 0.01, and a little more away from the middle of the picture.
    assert errors["0.1"] == pytest.approx(1.08, abs=0.04)
    assert errors["0.2"] == pytest.approx(0, abs=0.05)


def test_lags_longer_than_recording() -> None:
    errors = pixel_errors(_poses(5), _poses(5), torch.linspace(0, 0.3, 5, dtype=torch.float64), _CAMERA)
    assert math.isnan(errors["0.4"])
    assert errors["0.2"] < 1e-6


def _run(case: str, variant: str, seed: int, psnr: float) -> dict:
    end = {"degrees": 0.5, "translation": 0.02, "pixels": {"0.1": 0.1, "0.2": 0.2, "0.4": 0.4, "0.8": 0.8}}
    return {
        "scene": "room", "case": case, "variant": variant, "seed": seed,
        "placed": {"psnr": psnr}, "refined": {"psnr": psnr + 1}, "poses": end,
    }  # fmt: skip


def test_table_of_differences() -> None:
    runs = [
        _run("noise, corrected", "default", 1, 20.0), _run("noise, corrected", "default", 2, 30.0),
        _run("true poses", "default", 1, 21.0), _run("true poses", "default", 2, 33.0),
        _run("noise, corrected", "other", 1, 22.0), _run("noise, corrected", "other", 2, 31.0),
    ]  # fmt: skip
    rows = {(row["case"], row["variant"]): row for row in table(runs)}
    corrected = rows["noise, corrected", "default"]
    assert corrected["psnr_placed"] == {"mean": 25.0, "spread": 10.0}
    assert corrected["psnr_placed_less_than_true_poses"] == {"mean": 2.0, "spread": 2.0}
    assert rows["noise, corrected", "other"]["psnr_placed_more_than_default"] == {"mean": 1.5, "spread": 1.0}


def test_a_recording_without_poses_does_not_end_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def make(_: Runner, run: Run) -> dict:
        if "--poses events" in " ".join(run.convert):
            raise DataError("events", "they give no poses", "record longer")
        return {"results": {**_run("", "", 0, 30.0)["placed"], "refined_test_poses": {"psnr": 31.0}}}

    monkeypatch.setattr(Runner, "make", make)
    monkeypatch.setattr(Poses, "_pose_errors", lambda *_: _run("", "", 0, 30.0)["poses"])
    cases = ("from nothing, corrected", "true poses")
    Poses(tmp_path / "r.json", tmp_path / "work", tmp_path, scenes=("room",), cases=cases, seeds=(1,)).main()
    result = json.loads((tmp_path / "r.json").read_text())
    assert [run["case"] for run in result["runs"]] == ["true poses"]
    (failed,) = result["failed"]
    assert (failed["case"], failed["error"]) == (cases[0], "events: they give no poses; record longer")
