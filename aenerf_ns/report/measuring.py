"""Measure or read all that a report says of a run. Other files show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from nerfstudio.engine.trainer import TrainerConfig
from PIL import Image

from aenerf_ns.evaluation.evaluate import evaluate
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.report.pair_residuals import pair_residuals
from aenerf_ns.report.poses import measure_poses
from aenerf_ns.report.run_files import read_record, read_scalars
from aenerf_ns.report.view_pictures import ViewPictures, chosen_views, picture_views

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass
class RunReport:
    """All that a report says of a run.

    Attributes:
        name: of the run, by which the page tells runs apart.
        folder: of the run.
        config: the settings that tell runs apart: method, data, steps, pose correction, seed.
        record: see :func:`~aenerf_ns.report.run_files.read_record`.
        scalars: see :func:`~aenerf_ns.report.run_files.read_scalars`.
        evaluation: what ``ns-eval`` writes as results.
        contrast: of each channel; see :func:`~aenerf_ns.report.view_pictures.picture_views`.
        chosen: why a view is shown, by its file.
        pictures: by the file of the view.
        data: the check's lines and problems, the rate of the events and the account of the pairs.
        check_picture: of the check, or None.
        poses: positions and errors along the trajectory; see :func:`~aenerf_ns.report.poses.measure_poses`.
        pairs: see :func:`~aenerf_ns.report.pair_residuals.pair_residuals`.
        missing: what was not measured, and why.
    """

    name: str
    folder: Path
    config: dict[str, Any]
    record: dict[str, Any] | None = None
    scalars: dict[str, tuple[list[int], list[float]]] | None = None
    evaluation: dict[str, Any] = field(default_factory=dict)
    contrast: list[float] = field(default_factory=list)
    chosen: dict[str, str] = field(default_factory=dict)
    pictures: dict[str, ViewPictures] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)
    check_picture: Image.Image | None = None
    poses: dict[str, Any] = field(default_factory=dict)
    pairs: dict[str, Any] | None = None
    missing: list[str] = field(default_factory=list)

    @property
    def views(self) -> list[dict[str, Any]]:
        """Describe each reference view; see :func:`~aenerf_ns.training.view_metrics.describe_views`."""
        return self.evaluation.get("views", [])

    def as_json(self) -> dict[str, Any]:
        """Return all figures in plain values."""
        return {
            "name": self.name,
            "folder": str(self.folder),
            "config": self.config,
            "record": self.record,
            "evaluation": self.evaluation,
            "contrast_per_channel": self.contrast,
            "data": self.data,
            "poses": self.poses,
            "pairs": self.pairs,
            "scalars": self.scalars,
            "not_measured": self.missing,
        }


def measure_run(
    name: str,
    config: TrainerConfig,
    run: TrainedRun,
    candidates: Sequence[str] = (),
    shown: dict[str, str] | None = None,
) -> RunReport:
    """Measure a trained run.

    Args:
        name: of the run.
        config: of the run.
        run: as it is opened to be tested.
        candidates: the files of the views that may be shown; none means that all may.
        shown: the files of the views to show, and why; None chooses among the candidates by this run's metrics.
    """
    run.model.eval()
    folder = config.get_base_dir()
    report = RunReport(name, folder, _settings(config, run), read_record(folder), read_scalars(folder))
    missing = report.missing
    if report.record is None:
        missing.append("Commit, command, machine, seconds and peak memory: the run was made by an earlier version.")
    if report.scalars is None:
        missing.append("Curves: the run was made by an earlier version, which kept no scalars.")
    _views(report, run, candidates, shown)
    _data(report, run)
    report.poses = measure_poses(run)
    if report.poses["errors"] is None:
        missing.append("Pose errors: the recording has no true poses.")
    return report


def _settings(config: TrainerConfig, run: TrainedRun) -> dict[str, Any]:
    scene = run.scene
    camera = scene.event_camera
    return {
        "data": str(run.data),
        "method": config.method_name,
        "supervision": type(run.model.supervision).__name__,
        "pose_correction": run.model.config.camera_optimizer.mode,
        "color_correction": run.model.color_correction.protocol,
        "steps": config.max_num_iterations,
        "seed": config.machine.seed,
        "sensor": f"{camera.width} x {camera.height} pixels",
        "window_ns": [scene.window.start, scene.window.end],
        "thresholds": [scene.sensor.positive_contrast_threshold, scene.sensor.negative_contrast_threshold],
    }


def _views(report: RunReport, run: TrainedRun, candidates: Sequence[str], shown: dict[str, str] | None) -> None:
    if run.views is None and not run.model.camera_optimizer.has_ground_truth:
        report.missing.append("PSNR, SSIM and LPIPS: the recording has no test views.")
        return
    report.evaluation = evaluate(run)
    if not report.views:
        report.missing.append("PSNR, SSIM and LPIPS: the recording has no test views.")
        return
    if report.evaluation.get("lpips") is None:
        report.missing.append(f"LPIPS: {report.evaluation['lpips_absent']}.")
    if "refined_test_poses" not in report.evaluation:
        report.missing.append("Metrics from refined test poses: --pipeline.refine-test-poses False.")
    if all(view["time_ns"] is None for view in report.views):
        report.missing.append("Camera speed at the test views: they were not taken on the trajectory.")
    if shown is None:
        views = [view for view in report.views if not candidates or view["file"] in candidates]
        chosen = chosen_views([view["placed"]["psnr"] for view in views])
        shown = {views[index]["file"]: reason for index, reason in chosen.items()}
    report.chosen = shown
    indices = {view["file"]: index for index, view in enumerate(report.views)}
    pictures, report.contrast = picture_views(run, [indices[file] for file in shown])
    report.pictures = dict(zip(shown, pictures, strict=True))


def _data(report: RunReport, run: TrainedRun) -> None:
    """Measure what needs the events, where they still are."""
    # Imported lazily, because numba is slow to import.
    from aenerf_ns.checking.picture import warped_picture
    from aenerf_ns.checking.report import Report

    dataset = run.dataset
    scene = dataset.scene
    report.data = {"pose_gaps_ns": [list(gap) for gap in scene.window.gaps], "check": [], "problems": []}
    if not scene.event_file.path.is_file():
        report.missing.append(
            f"Rate, polarity, pairs and the check: the events are no longer at {scene.event_file.path}."
        )
        return
    recording = run.recording
    scale = run.scene.scale
    check = Report(recording, scene.window, scale, report.data["check"].append)
    statistics = check.statistics
    report.data |= {
        "problems": check.problems,
        "num_events": int(statistics.counts.sum()),
        "num_positive": statistics.num_positive,
        "start_ns": statistics.start,
        "end_ns": statistics.end,
        "rate": _per_second(statistics.rate, statistics.start, statistics.end),
    }
    if check.warped is None:
        report.missing.append("The check's picture: too few events have a pose.")
    else:
        report.check_picture = Image.fromarray(warped_picture(check.warped))
    report.pairs = pair_residuals(run)
    if report.pairs is None:
        report.missing.append("Rendered against measured changes: the batches of this method are no pairs of events.")
    else:
        report.data["pairs"] = dataset.pairs.summary()


def _per_second(counts: NDArray[np.int64], start: int, end: int) -> list[float]:
    return (counts * (len(counts) / max(end - start, 1) * 1e9)).tolist()
