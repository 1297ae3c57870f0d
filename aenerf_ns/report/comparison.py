"""Comparing runs: whether they were measured alike, and how far they are apart view by view."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from aenerf_ns.report.measuring import RunReport


def protocol_differences(reports: Sequence[RunReport]) -> list[str]:
    """Return in words how the runs were measured differently; none if their figures can be compared."""
    first, *others = reports
    found = []
    for other in others:
        for what in ("color_correction", "test_poses"):
            ours, theirs = (report.evaluation.get(what) for report in (first, other))
            if ours != theirs:
                named = what.replace("_", " ")
                found.append(f"{named}: {ours} ({first.name}), {theirs} ({other.name})")
        missing = set(first.truths.items()) ^ set(other.truths.items())
        if missing:
            found.append(
                f"test views: {len(first.truths)} ({first.name}) and {len(other.truths)} ({other.name}), of which "
                f"{len(set(first.truths.items()) & set(other.truths.items()))} are the same image"
            )
    return found


def paired_differences(reports: Sequence[RunReport]) -> list[dict[str, Any]]:
    """Return how the metrics of each later run differ from the first run's on the same views.

    Returns:
        For each run, each protocol ("placed", "refined") and each metric that both have: the mean difference, its 95 %
        confidence interval by Student's t over the views (None with fewer than two), and the number of views.
    """
    first, *others = reports
    ours = {view["file"]: view for view in first.views}
    rows = []
    for other in others:
        shared = [
            (ours[view["file"]], view)
            for view in other.views
            if first.truths.get(view["file"]) == other.truths.get(view["file"])
        ]
        for protocol in ("placed", "refined"):
            for metric in ("psnr", "ssim", "lpips"):
                pairs = [
                    (one[protocol][metric], two[protocol][metric])
                    for one, two in shared
                    if metric in one.get(protocol, {}) and metric in two.get(protocol, {})
                ]
                if pairs:
                    differences = np.array([theirs - own for own, theirs in pairs])
                    rows.append(
                        {
                            "run": other.name,
                            "minus": first.name,
                            "test_poses": protocol,
                            "metric": metric,
                            "num_views": len(pairs),
                            "mean": float(differences.mean()),
                            "interval": confidence_interval(differences),
                        }
                    )
    return rows


def confidence_interval(values: np.ndarray) -> tuple[float, float] | None:
    """Return the 95 % confidence interval of the mean of (N,) values by Student's t, None with fewer than two.

    Example:
        >>> low, high = confidence_interval(np.array([1.0, 2.0, 3.0]))
        >>> round(low, 3), round(high, 3)
        (-0.484, 4.484)
    """
    if len(values) < 2:
        return None
    half = float(stats.t.ppf(0.975, len(values) - 1)) * float(values.std(ddof=1)) / math.sqrt(len(values))
    mean = float(values.mean())
    return mean - half, mean + half
