"""The metrics of a run, and the protocol that they are computed with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aenerf_ns.errors import DataError
from aenerf_ns.evaluation.pose_refinement import NUM_STEPS
from aenerf_ns.evaluation.poses import compare_with_ground_truth, describe_test_poses
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import IMAGE_METRICS, average_metrics, describe_views, measure_reference_views
from aenerf_ns.method.color_correction import AffineColorCorrection


def evaluate(run: TrainedRun, output: Path | None = None, with_deviations: bool = True) -> dict[str, Any]:
    """Compute mean metrics over the reference views, the errors of the poses, and the protocol behind them.

    The views are rendered from where they are placed. ``refined_test_poses`` holds the metrics of the views that are
    rendered from photometrically refined poses, and ``views`` those of each view
    (:func:`~aenerf_ns.evaluation.view_metrics.describe_views`). No camera stays moved.

    Without reference views, but with known true poses, the errors of the poses are all.

    Args:
        run: as it is opened to be tested.
        output: existing folder for pictures, or None.
        with_deviations: add the standard deviations over the views.

    Raises:
        DataError: there are neither views nor true poses, or the model renders values that are not finite.
    """
    model, correction = run.model, run.model.camera_optimizer
    metrics: dict[str, Any] = {}
    placed: list[dict[str, float]] = []
    refined = None
    if run.views is not None or not correction.has_ground_truth:
        placed = measure_reference_views(run, output)
        metrics = _finite_means(run, placed, with_deviations)
    metrics["color_correction"] = model.color_correction.description
    if isinstance(model.color_correction, AffineColorCorrection):
        metrics["color_correction_slope"] = model.color_correction.scale.tolist()
    metrics["num_views"] = len(placed)
    metrics["pose_correction"] = correction.config.mode
    metrics |= correction.offsets()
    metrics["pose_errors"] = compare_with_ground_truth(correction, run.scene)
    metrics["pose_diagnosis"] = run.pose_diagnosis
    metrics["test_poses"] = describe_test_poses(correction)
    if placed and run.refine_test_poses:
        refined = measure_reference_views(run, refine=True)
        means = _finite_means(run, refined, with_deviations)
        protocol = f"photometric refinement, {NUM_STEPS} Levenberg-Marquardt steps, from: {metrics['test_poses']}"
        metrics["refined_test_poses"] = {
            # The time to render includes no refinement, so it says nothing new.
            **{name: value for name, value in means.items() if name.removesuffix("_std") in IMAGE_METRICS},
            **({} if model.image_metrics.lpips_absent is None else {"lpips": None}),
            "test_poses": protocol,
        }
    metrics |= model.supervision.learned_values()
    if model.image_metrics.lpips_absent is not None:
        metrics |= {"lpips": None, "lpips_absent": model.image_metrics.lpips_absent}
    metrics["views"] = describe_views(run, placed, refined) if placed else []
    return metrics


def _finite_means(run: TrainedRun, measured: Sequence[dict[str, float]], with_deviations: bool) -> dict[str, Any]:
    """Return the means of the metrics of views, or raise a DataError if one is not a number."""
    metrics = average_metrics(measured, with_deviations)
    undefined = [name for name, value in metrics.items() if math.isnan(value)]
    if undefined:
        raise DataError(
            run.data,
            f"{', '.join(undefined)} of the test views is not a number: the model renders values that are not finite",
            "train it again",
        )
    return metrics
