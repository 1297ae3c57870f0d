"""Measure or read all that a report says of a run. Other files show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgspec
from nerfstudio.engine.trainer import TrainerConfig
from PIL import Image

from aenerf_ns.evaluation.evaluate import evaluate
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.report.pair_residuals import PairResiduals, measure_pair_residuals
from aenerf_ns.report.poses import RunPoses, measure_poses
from aenerf_ns.report.run_files import TrainingRecord, read_record, read_scalars
from aenerf_ns.report.view_pictures import ViewPictures, choose_views, picture_views


@dataclass
class EventFigures:
    """Figures of a recording's events.

    Attributes:
        num_events: all of them.
        num_positive: those of polarity +1.
        start_ns: time of the first event.
        end_ns: time of the last event.
        rate: events per second in equal parts of the time between.
    """

    num_events: int
    num_positive: int
    start_ns: int
    end_ns: int
    rate: list[float]


@dataclass
class DataReport:
    """What a run was trained on.

    Attributes:
        pose_gaps_ns: first and last time of each gap of the poses.
        check: the figures that ``aenerf check`` prints.
        problems: what it finds wrong.
        events: None where the events are no longer there.
        pairs: the account of the pairs, None where batches are not pairs of events.
        check_picture: :meth:`~aenerf_ns.checking.contrast.WarpedEvents.picture`; None if too few events have a pose.
    """

    pose_gaps_ns: list[list[int]]
    check: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    events: EventFigures | None = None
    pairs: str | None = None
    check_picture: Image.Image | None = None

    def as_json(self) -> dict[str, Any]:
        """Return all figures in plain values, without those that are not known."""
        figures: dict[str, Any] = {
            "pose_gaps_ns": self.pose_gaps_ns,
            "check": self.check,
            "problems": self.problems,
        }
        if self.events is not None:
            figures |= asdict(self.events)
        if self.pairs is not None:
            figures["pairs"] = self.pairs
        return figures


@dataclass
class RunReport:
    """All that a report says of a run.

    Attributes:
        name: by which the page tells runs apart.
        folder: of the run.
        config: the settings that tell runs apart: method, data, steps, pose correction, seed.
        record: how the run was made, or None.
        scalars: see :func:`~aenerf_ns.report.run_files.read_scalars`.
        data: what the run was trained on.
        poses: along the trajectory.
        evaluation: what ``ns-eval`` writes as results.
        contrast: of each channel; see :func:`~aenerf_ns.report.view_pictures.picture_views`.
        chosen: why a view is shown, by its file.
        pictures: by the file of the view.
        pairs: rendered against measured changes, or None.
        missing: what was not measured, and why.
    """

    name: str
    folder: Path
    config: dict[str, Any]
    record: TrainingRecord | None
    scalars: dict[str, tuple[list[int], list[float]]] | None
    data: DataReport
    poses: RunPoses
    evaluation: dict[str, Any] = field(default_factory=dict)
    contrast: list[float] = field(default_factory=list)
    chosen: dict[str, str] = field(default_factory=dict)
    pictures: dict[str, ViewPictures] = field(default_factory=dict)
    pairs: PairResiduals | None = None
    missing: list[str] = field(default_factory=list)

    @property
    def views(self) -> list[dict[str, Any]]:
        """Description of each reference view; see :func:`~aenerf_ns.evaluation.view_metrics.describe_views`."""
        return self.evaluation.get("views", [])

    def as_json(self) -> dict[str, Any]:
        """Return all figures in plain values."""
        return {
            "name": self.name,
            "folder": str(self.folder),
            "config": self.config,
            "record": msgspec.to_builtins(self.record),
            "evaluation": self.evaluation,
            "contrast_per_channel": self.contrast,
            "data": self.data.as_json(),
            "poses": asdict(self.poses),
            "pairs": None if self.pairs is None else asdict(self.pairs),
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
        run: opened to be tested.
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
        DataReport([list(gap) for gap in run.scene.window.gaps]),
        measure_poses(run),
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

    scene, data = run.scene, report.data
    if not scene.event_file.path.is_file():
        report.missing.append(
            f"Rate, polarity, pairs and the check: the events are no longer at {scene.event_file.path}."
        )
        return
    found = check(run.recording, scene.window, scene.scale)
    data.check, data.problems, counted = found.figures, found.problems, found.statistics
    parts_per_second = len(counted.rate) / max(counted.end - counted.start, 1) * 1e9
    rate = (counted.rate * parts_per_second).tolist()
    data.events = EventFigures(counted.num_events, counted.num_positive, counted.start, counted.end, rate)
    if found.warped is None:
        report.missing.append("The check's picture: too few events have a pose.")
    else:
        data.check_picture = Image.fromarray(found.warped.picture())
    report.pairs = measure_pair_residuals(run)
    if report.pairs is None:
        report.missing.append("Rendered against measured changes: the batches of this method are no pairs of events.")
    else:
        data.pairs = run.dataset.pairs.summary()
