"""How far runs are apart, view by view."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from aenerf_ns.report.measuring import RunReport


def paired_differences(reports: Sequence[RunReport], shared: Sequence[str]) -> list[dict[str, Any]]:
    """Compare the metrics of each later run with the first run's on the same views.

    Args:
        reports: of the runs.
        shared: the files of the views that all runs have; other views are left out.

    Returns:
        For each later run, each protocol ("placed", "refined") and each metric that both runs have: the mean
        difference, its 95 % confidence interval by Student's t over the views (None with fewer than two), and the
        number of views.
    """
    first, *others = reports
    ours = {view["file"]: view for view in first.views}
    rows = []
    for other in others:
        theirs = {view["file"]: view for view in other.views}
        for protocol in ("placed", "refined"):
            for metric in ("psnr", "ssim", "lpips"):
                pairs = [
                    (ours[file][protocol][metric], theirs[file][protocol][metric])
                    for file in shared
                    if all(metric in views[file].get(protocol, {}) for views in (ours, theirs))
                ]
                if pairs:
                    differences = np.array([later - earlier for earlier, later in pairs])
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


def views_left_out(reports: Sequence[RunReport], shared: Sequence[str]) -> dict[str, list[str]]:
    """Return the files of the views that are not in all runs, by the name of the run; runs with none are left out."""
    left_out = {report.name: [v["file"] for v in report.views if v["file"] not in set(shared)] for report in reports}
    return {name: files for name, files in left_out.items() if files}


def confidence_interval(values: np.ndarray) -> tuple[float, float] | None:
    """Compute the 95 % confidence interval of the mean of (N,) values by Student's t, None with fewer than two.

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
