"""How runs are measured, which views all of them have, and how far apart they are on these views."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from aenerf_ns.evaluation.poses import describe_test_poses
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import IMAGE_METRICS, view_files
from aenerf_ns.report.measuring import RunReport


@dataclass(frozen=True)
class Protocol:
    """How a run is measured, which is known before anything is measured.

    ``truths`` holds a checksum of each test view's image, by the view's file.
    """

    color_correction: str
    test_poses: str
    truths: dict[str, int]


def read_protocol(run: TrainedRun) -> Protocol:
    """Return how a run will be measured, as it is opened to be tested."""
    truths = {}
    if run.views is not None:
        for index, file in enumerate(view_files(run)):
            truths[file] = zlib.crc32(run.views.get_numpy_image(index).tobytes())
    correction = run.model.color_correction
    color_correction = f"{correction.protocol}, fitted on {correction.fitted_on}"
    return Protocol(color_correction, describe_test_poses(run.model.camera_optimizer), truths)


def protocol_differences(names: Sequence[str], protocols: Sequence[Protocol]) -> list[str]:
    """Say how runs are measured differently from the first; nothing if their figures can be compared."""
    found = []
    first = protocols[0]
    for name, other in zip(names[1:], protocols[1:], strict=True):
        for what in ("color_correction", "test_poses"):
            ours, theirs = getattr(first, what), getattr(other, what)
            if ours != theirs:
                found.append(f"{what.replace('_', ' ')}: {ours} ({names[0]}), {theirs} ({name})")
        same = shared_views([first, other])
        if not len(same) == len(first.truths) == len(other.truths):
            found.append(
                f"test views: {len(first.truths)} ({names[0]}) and {len(other.truths)} ({name}); both runs have "
                f"{len(same)} images of the same name and content"
            )
    return found


def shared_views(protocols: Sequence[Protocol]) -> list[str]:
    """Return the files of the test views that all runs have, with the same image, in the order of the first run."""
    first, *others = (protocol.truths for protocol in protocols)
    return [file for file, truth in first.items() if all(other.get(file) == truth for other in others)]


def views_left_out(reports: Sequence[RunReport], shared: Sequence[str]) -> dict[str, list[str]]:
    """Return the files of the views that are not in all runs, by the name of the run; runs with none are left out."""
    left_out = {report.name: [v["file"] for v in report.views if v["file"] not in set(shared)] for report in reports}
    return {name: files for name, files in left_out.items() if files}


def paired_differences(reports: Sequence[RunReport], shared: Sequence[str]) -> list[dict[str, Any]]:
    """Compare the metrics of each later run with the first run's on the views that all runs have.

    Each row holds the mean difference of a metric from ``placed`` or ``refined`` test poses, and the 95 %
    confidence interval of the mean over the views by Student's t, None for one view.
    """
    first, *others = reports
    ours = {view["file"]: view for view in first.views}
    rows = []
    for other in others:
        theirs = {view["file"]: view for view in other.views}
        for protocol in ("placed", "refined"):
            pairs = [(ours[file].get(protocol, {}), theirs[file].get(protocol, {})) for file in shared]
            for metric in IMAGE_METRICS:
                differences = np.array([b[metric] - a[metric] for a, b in pairs if metric in a and metric in b])
                if len(differences):
                    mean, count = float(differences.mean()), len(differences)
                    half = float(stats.t.ppf(0.975, count - 1) * stats.sem(differences)) if count > 1 else None
                    interval = None if half is None else (mean - half, mean + half)
                    row = {"run": other.name, "minus": first.name, "test_poses": protocol, "metric": metric}
                    rows.append({**row, "num_views": count, "mean": mean, "interval": interval})
    return rows
