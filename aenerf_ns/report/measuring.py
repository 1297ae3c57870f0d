"""Measure or read all that a report says of a run. Other files show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from nerfstudio.engine.trainer import TrainerConfig

from aenerf_ns.evaluation.evaluate import evaluate
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.recording.poses_report import PosesReport, read_poses_report
from aenerf_ns.report.pair_residuals import PairResiduals, measure_pair_residuals
from aenerf_ns.report.poses import RunPoses, measure_poses
from aenerf_ns.report.run_files import TrainingRecord, read_record, read_scalars
from aenerf_ns.report.view_pictures import ViewPictures, choose_views, picture_views

if TYPE_CHECKING:
    from aenerf_ns.checking.result import CheckResult
    from aenerf_ns.events.polarity_drift import PolarityDrift


@dataclass
class RunReport:
    """All that a report says of a run.

    Attributes:
        name: by which the page tells runs apart.
        folder: of the run.
        config: the settings that tell runs apart: method, data, steps, pose correction, seed.
        record: how the run was made, or None.
        scalars: see :func:`~aenerf_ns.report.run_files.read_scalars`.
        pose_gaps_ns: first and last time of each gap of the poses.
        poses: along the trajectory.
        estimation: how the given poses were estimated or refined, None where the recording does not say.
        check: what ``aenerf check`` finds in the data, None where the events are no longer there.
        evaluation: what ``ns-eval`` writes as results.
        contrast: of each channel; see :func:`~aenerf_ns.report.view_pictures.picture_views`.
        chosen: why a view is shown, by its file.
        pictures: by the file of the view.
        pairs: rendered against measured changes, None where batches are not pairs of events.
        num_pairs: the account of the pairs, in words.
        drift: how the thresholds of the pixels differ, None where batches are not pairs of events.
        missing: what was not measured, and why.
    """

    name: str
    folder: Path
    config: dict[str, Any]
    record: TrainingRecord | None
    scalars: dict[str, tuple[list[int], list[float]]] | None
    pose_gaps_ns: list[list[int]]
    poses: RunPoses
    estimation: PosesReport | None = None
    check: CheckResult | None = None
    evaluation: dict[str, Any] = field(default_factory=dict)
    contrast: list[float] = field(default_factory=list)
    chosen: dict[str, str] = field(default_factory=dict)
    pictures: dict[str, ViewPictures] = field(default_factory=dict)
    pairs: PairResiduals | None = None
    num_pairs: str | None = None
    drift: PolarityDrift | None = None
    missing: list[str] = field(default_factory=list)

    @property
    def views(self) -> list[dict[str, Any]]:
        """Description of each reference view; see :func:`~aenerf_ns.evaluation.view_metrics.describe_views`."""
        return self.evaluation.get("views", [])

    def as_json(self) -> dict[str, Any]:
        """Return all figures in plain values."""
        data: dict[str, Any] = {"pose_gaps_ns": self.pose_gaps_ns, "check": [], "problems": []}
        if self.check is not None:
            events = self.check.statistics
            data |= {
                "check": self.check.figures,
                "problems": self.check.problems,
                "num_events": events.num_events,
                "num_positive": events.num_positive,
                "start_ns": events.start,
                "end_ns": events.end,
                "rate": self.check.events_per_second,
            }
        if self.estimation is not None:
            data["estimation"] = self.estimation.summary
        if self.num_pairs is not None:
            data["pairs"] = self.num_pairs
        if self.drift is not None:
            data["drift_spread"] = self.drift.spread
        return {
            "name": self.name,
            "folder": str(self.folder),
            "config": self.config,
            "record": msgspec.to_builtins(self.record),
            "evaluation": self.evaluation,
            "contrast_per_channel": self.contrast,
            "data": data,
            "poses": asdict(self.poses),
            "pairs": None if self.pairs is None else asdict(self.pairs),
            "scalars": self.scalars,
            "not_measured": self.missing,
        }


def measure_run(
    name: str, config: TrainerConfig, run: TrainedRun, candidates: Sequence[str], shown: dict[str, str] | None
) -> RunReport:
    """Measure a trained run that is opened to be tested.

    Args:
        name: by which the page tells the run apart.
        candidates: the files of the views that may be shown; none means that all may.
        shown: the files of the views to show, and why; None chooses among the candidates by this run's metrics.
    """
    folder = config.get_base_dir()
    report = RunReport(
        name,
        folder,
        _settings(config, run),
        read_record(folder),
        read_scalars(folder),
        [list(gap) for gap in run.scene.window.gaps],
        measure_poses(run),
        read_poses_report(run.recording.trajectory),
    )
    missing = report.missing
    if report.record is None:
        missing.append("Commit, command, machine, seconds and peak memory: the run was made by an earlier version.")
    if report.scalars is None:
        missing.append("Curves: the run was made by an earlier version, which kept no scalars.")
    _measure_views(report, run, candidates, shown)
    _measure_data(report, run)
    if report.poses.errors is None:
        missing.append("Pose errors: the recording has no true poses.")
    return report


def _settings(config: TrainerConfig, run: TrainedRun) -> dict[str, Any]:
    scene, model = run.scene, run.model
    return {
        "data": str(run.data),
        "method": config.method_name,
        "supervision": type(model.supervision).__name__,
        "pose_correction": model.config.camera_optimizer.mode,
        "color_correction": model.color_correction.protocol,
        "steps": config.max_num_iterations,
        "seed": config.machine.seed,
        "sensor": f"{scene.event_camera.width} x {scene.event_camera.height} pixels",
        "window_ns": [scene.window.start, scene.window.end],
        "thresholds": [scene.sensor.positive_contrast_threshold, scene.sensor.negative_contrast_threshold],
    }


def _measure_views(report: RunReport, run: TrainedRun, candidates: Sequence[str], shown: dict[str, str] | None) -> None:
    if run.views is not None or run.model.camera_optimizer.has_ground_truth:
        report.evaluation = evaluate(run)
    else:
        report.evaluation = {"pose_diagnosis": run.pose_diagnosis}
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
        chosen = choose_views([view["placed"]["psnr"] for view in views])
        shown = {views[index]["file"]: reason for index, reason in chosen.items()}
    report.chosen = shown
    indices = {view["file"]: index for index, view in enumerate(report.views)}
    pictures, report.contrast = picture_views(run, [indices[file] for file in shown])
    report.pictures = dict(zip(shown, pictures, strict=True))


def _measure_data(report: RunReport, run: TrainedRun) -> None:
    """Measure what needs the events, where they still are."""
    # Imported lazily, because numba is slow to import.
    from aenerf_ns.checking.report import check

    scene = run.scene
    if not scene.event_file.path.exists():
        report.missing.append(
            f"Rate, polarity, pairs and the check: the events are no longer at {scene.event_file.path}."
        )
        return
    report.check = check(run.recording, run.recording.frames, scene.window, scene.scale)
    if report.check.warped is None:
        report.missing.append("The check's picture: too few events have a pose.")
    report.pairs = measure_pair_residuals(run)
    if report.pairs is None:
        report.missing.append("Rendered against measured changes: no pairs that this run draws end at events.")
    else:
        report.num_pairs = run.dataset.pairs.summary()
        report.drift = run.dataset.polarity_drift
