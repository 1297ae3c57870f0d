"""The diagnosis of pose correction: what it sees in poses that are right, wrong or not moving, and what it says."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.small_datasets import END, START
from helpers.small_pipelines import make_pipeline, make_pipeline_config
from helpers.small_trainings import train_small_model
from helpers.streams import make_stream
from nerfstudio.utils.eval_utils import eval_setup

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.rotation import rotation_from_vector
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.evaluation.pose_diagnosis import diagnose, summarize
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.writer import NativeDatasetWriter
from aenerf_ns.supervision.base import LossCoefficients, SamplerConfig, SupervisionConfig
from aenerf_ns.supervision.peers.frames import FrameSampler, FrameSupervision
from aenerf_ns.training.pipeline import AENeRFPipeline

CAMERA = CameraIntrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
SECOND = 10**9


def write_dots(folder: Path, speed: float = 1.0) -> None:
    """Write a second of a camera that slides and turns past dots; a dot triggers an event in each pixel it enters."""
    rng = np.random.default_rng(0)
    dots = np.stack([rng.uniform(-4, 4, 3000), rng.uniform(-2, 2, 3000), rng.uniform(1.5, 2.5, 3000)], 1)
    polarity = rng.choice([-1, 1], 3000)
    times = np.linspace(0, SECOND, 1001).astype(np.int64)
    phase = torch.from_numpy(speed * times / SECOND)
    turns = torch.stack([0.2 * torch.sin(9 * phase), 0.2 * torch.cos(8 * phase), 0.1 * phase], 1)
    places = torch.stack([phase - 0.5, 0.1 * torch.sin(6 * phase), 0.1 * torch.cos(5 * phase)], 1)
    poses = torch.cat([rotation_from_vector(turns), places[..., None]], -1)
    seen = np.einsum("tji,tnj->tni", poses[..., :3].numpy(), dots[None] - poses[:, None, :, 3].numpy())
    x, y = (np.floor(60 * seen[..., i] / seen[..., 2] + (32, 24)[i]).astype(np.int64) for i in (0, 1))
    inside = (x >= 0) & (x < 64) & (y >= 0) & (y < 48)
    moved = np.zeros_like(inside)
    moved[1:] = (x[1:] != x[:-1]) | (y[1:] != y[:-1])
    step, dot = (moved & inside).nonzero()
    if speed == 0:
        # Noise alone.
        step, dot = np.repeat(np.arange(1, 1001), 10), rng.choice(inside[0].nonzero()[0], 10_000)
    events = make_stream(np.stack([x[step, dot], y[step, dot], times[step], polarity[dot]], 1), 64, 48)
    with NativeDatasetWriter(folder, CAMERA, SensorModel(), "srgb") as writer:
        writer.events.append(events)
        writer.add_trajectories(Trajectory(times, poses), None)


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("diagnosis") / "dots"
    write_dots(folder)
    return folder


def diagnosed(pipeline: AENeRFPipeline) -> dict[str, Any]:
    return diagnose(pipeline.trained_run())


def move(pipeline: AENeRFPipeline, size: float) -> None:
    """Turn the corrected poses by different angles at every knot."""
    twists = pipeline.model.camera_optimizer.twists
    with torch.no_grad():
        twists.control_twists[:, 3:] = size * torch.randn(
            len(twists.control_twists), 3, generator=torch.Generator().manual_seed(0)
        )


def test_right_poses_show_no_failure_in_events(dots: Path) -> None:
    pipeline = make_pipeline(dots, "val", pose_correction="spline")
    state = torch.get_rng_state()
    figures = diagnosed(pipeline)
    assert torch.equal(torch.get_rng_state(), state)
    assert pipeline.model.training
    assert figures["contrast_corrected"] == pytest.approx(figures["contrast_estimated"], rel=1e-6)
    assert not figures["contrast_is_clearly_lower"]
    assert figures["correction_rotation_degrees"] == pytest.approx(0, abs=1e-5)
    # Stretches cover the time, and an untrained field leaves all of the loss.
    starts, ends = ([stretch[f"{end}_seconds"] for stretch in figures["stretches"]] for end in ("start", "end"))
    assert np.all(np.diff([starts, ends], axis=0) > 0)
    assert np.subtract(starts[1:], ends[:-1]) == pytest.approx(0, abs=0.01)
    assert (starts[0], ends[-1]) == pytest.approx((0, 1), abs=0.05)
    for stretch in figures["stretches"]:
        assert stretch["loss"] == pytest.approx(stretch["loss_of_constant_field"], rel=0.05)
    assert "poses not corrected" in figures["summary"]
    assert "weak stretches: 10 of 10" in figures["summary"]
    assert diagnosed(pipeline) == figures


def test_spoiled_poses_are_seen_in_events(dots: Path) -> None:
    pipeline = make_pipeline(dots, "val", pose_correction="spline")
    move(pipeline, 0.1)
    figures = diagnosed(pipeline)
    assert figures["contrast_corrected"] < 0.9 * figures["contrast_estimated"]
    assert figures["correction_rotation_degrees"] > 2
    extent = pipeline.datamanager.train_dataset.scene.trajectory.extent
    shift = figures["correction_translation_recording_units"]
    scale = pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    assert scale != 1
    assert figures["correction_translation_extents"] == pytest.approx(shift * scale / extent)
    assert "turned too far" in figures["summary"]


def test_a_long_recording_is_judged_by_consecutive_events(dots: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = make_pipeline(dots, "val", pose_correction="spline")
    whole = diagnosed(pipeline)["contrast_corrected"]
    # The events are then read in eight runs, and the viewer looks at one of twenty.
    monkeypatch.setattr("aenerf_ns.checking.contrast._DENSITIES", (1.0,))
    monkeypatch.setattr("aenerf_ns.recording.dataset._TIMELINE_ROWS", 2000)
    pipeline = make_pipeline(dots, "val", pose_correction="spline")
    figures = diagnosed(pipeline)
    assert figures["contrast_corrected"] == pytest.approx(whole, rel=0.1)


@pytest.mark.parametrize("mode", ["spline", "network"])
def test_still_camera_and_few_events_can_be_diagnosed(tmp_path: Path, mode: str) -> None:
    write_dots(tmp_path / "still", speed=0.0)
    config = make_pipeline_config(tmp_path / "still", pose_correction=mode)
    config.datamanager.dataparser.auto_scale_poses = False
    still = diagnosed(config.setup(device="cpu", test_mode="val"))
    assert still["contrast_corrected"] is not None
    # Two events.
    few = diagnosed(make_pipeline(tmp_path / "few", "val", pose_correction=mode))
    assert few["contrast_corrected"] is None
    for figures in (still, few):
        json.dumps(figures, allow_nan=False)


def test_a_method_that_reads_no_events_is_diagnosed_without_them(native: Path) -> None:
    config = make_pipeline_config(native, pose_correction="spline")
    config.datamanager.dataparser.start_time_ns, config.datamanager.dataparser.end_time_ns = START, END
    config.datamanager.sampler = SamplerConfig(_target=FrameSampler)
    config.model.supervision = SupervisionConfig(_target=FrameSupervision)
    config.model.loss_coefficients = LossCoefficients()
    (native / "events.h5").unlink()
    figures = diagnosed(config.setup(device="cpu", test_mode="val"))
    assert figures["contrast_corrected"] is None
    assert figures["stretches"] == []
    json.dumps(figures, allow_nan=False)


def test_last_step_is_diagnosed_and_kept_in_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save = {"steps_per_save": 2, "save_only_latest_checkpoint": False}
    first = train_small_model(tmp_path, "first", 3, schedule_length=8)
    trainer = train_small_model(tmp_path, "second", 5, load_dir=first.checkpoint_dir, **save)
    # Not that of the run that this one goes on from.
    kept = [torch.load(path, weights_only=True)["pipeline"] for path in sorted(trainer.checkpoint_dir.iterdir())]
    *before, found = [weights["_extra_state"] for weights in kept]
    assert before == [None] * 2
    assert found["correction_rotation_degrees"] > 0
    _, opened, *_ = eval_setup(trainer.base_dir / "config.yml")
    monkeypatch.setattr(opened.model, "get_image_metrics_and_images", lambda *_: ({"psnr": 20.0, "ssim": 0.5}, {}))
    assert opened.get_average_eval_image_metrics()["pose_diagnosis"] == found
    # Checkpoints of before have no diagnosis.
    del kept[-1]["_extra_state"]
    older = make_pipeline(tmp_path / "data", "test", pose_correction="spline")
    older.load_pipeline(kept[-1], 7)
    assert older.get_extra_state() is None


GOOD: dict[str, Any] = {
    "correction_rotation_degrees": 0.5,
    "correction_translation_recording_units": 0.02,
    "correction_translation_extents": 0.01,
    "clock_change_share_of_limit": 0.0,
    "contrast_estimated": 0.5,
    "contrast_corrected": 0.52,
    "contrast_is_clearly_lower": False,
    "stretches": [
        {"start_seconds": 0.4 * i, "end_seconds": 0.4 * (i + 1), "loss": loss, "loss_of_constant_field": 2.0}
        for i, loss in enumerate((0.08, 0.28, 0.08, 0.06, 0.08))
    ],
}
WEAK = {"start_seconds": 1.2, "end_seconds": 1.6, "loss": 0.5, "loss_of_constant_field": 2.0}


@pytest.mark.parametrize(
    ("change", "sign"),
    [
        ({}, None),
        ({"stretches": []}, None),
        ({"contrast_estimated": None, "contrast_corrected": None}, None),
        ({"correction_rotation_degrees": 0.02, "correction_translation_extents": 4e-4}, "poses not corrected"),
        # Turned or moved alone.
        ({"correction_rotation_degrees": 0.02}, None),
        ({"correction_translation_extents": 4e-4}, None),
        ({"contrast_is_clearly_lower": True}, "turned too far"),
        ({"clock_change_share_of_limit": 0.95}, "clock at its limit"),
        ({"clock_change_share_of_limit": 0.5}, None),
        (
            {"stretches": [*GOOD["stretches"], WEAK]},
            "weak stretches: 1 of 6, the worst from 1.2 to 1.6 s with 25% of the loss",
        ),
    ],
)
def test_summary_names_each_sign(change: dict[str, Any], sign: str | None) -> None:
    line = summarize({**GOOD, **change})
    assert (f"Signs of failure: {sign}" if sign else "No sign of failure.") in line
    has_contrast = change.get("contrast_corrected", 1) is not None
    assert ("contrast of warped events 0.500 before, 0.520 after" in line) == has_contrast
