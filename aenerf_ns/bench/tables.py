"""Tables of a benchmark's figures, in the layout of the paper's tables 1, 3 and 4, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean, stdev
from typing import Any

from aenerf_ns.bench.plan import CEILING, LOSSES, OURS, TRUE_POSES, WITHOUT_CORRECTION

Figures = dict[str, Any]
_METRICS = ("psnr", "ssim", "lpips")
_METHODS = (WITHOUT_CORRECTION, OURS, TRUE_POSES, CEILING)


def report(figures: Sequence[Figures], missing: Sequence[str]) -> str:
    """All tables of the figures of some runs, and the names of the runs that are missing."""
    methods, losses = ([one for one in figures if one["table"] == table] for table in ("methods", "losses"))
    parts = ["# Benchmark", _conditions(figures)]
    if missing:
        parts.append(f"**Not complete:** {len(missing)} runs are missing: {', '.join(missing)}.")
    if methods:
        parts += [
            "## Novel views (the paper's table 1)",
            methods_table(methods),
            "## Pose correction (the paper's table 3)",
            "RE: rotation error in degrees, TE: translation error in percent of the length of the path; both after "
            "Sim(3) alignment; with pose correction and without it.",
            poses_table(methods),
        ]
    if losses:
        parts += ["## Losses (the paper's table 4), hard speed", losses_table(losses)]
    if figures:
        parts += ["## Every scene", scenes_table(figures)]
    return "\n\n".join(parts) + "\n"


def methods_table(figures: Sequence[Figures]) -> str:
    """Means over scenes and seeds for each method, kind of scene and speed."""
    columns = [(kind, speed) for kind in ("object", "large") for speed in ("easy", "hard")]
    columns = [column for column in columns if _of(figures, kind=column[0], speed=column[1])]
    header = ["method"] + [f"{kind} scenes, {speed}: {m.upper()}" for kind, speed in columns for m in _METRICS]
    rows = []
    for method in _METHODS:
        if _of(figures, row=method):
            cells = [
                _mean(_of(figures, row=method, kind=kind, speed=speed), metric)
                for kind, speed in columns
                for metric in _METRICS
            ]
            rows.append([method, *cells])
    return _markdown(header, rows)


def poses_table(figures: Sequence[Figures]) -> str:
    """Errors of the poses after the correction and before it, means over scenes and seeds."""
    corrected = _of(figures, row=OURS)
    speeds = [speed for speed in ("easy", "hard") if _of(corrected, speed=speed)]
    header = ["", *(f"{speed}: {which} ψ" for speed in speeds for which in ("with", "without"))]
    rows = []
    for name, key in (("RE", "rotation_error_degrees"), ("TE", "translation_error_percent")):
        cells = [
            f"{fmean(one['results']['pose_errors'][which][key] for one in _of(corrected, speed=speed)):.3f}"
            for speed in speeds
            for which in ("corrected", "estimated")
        ]
        rows.append([name, *cells])
    return _markdown(header, rows)


def losses_table(figures: Sequence[Figures]) -> str:
    """Means over scenes and seeds for each set of losses."""
    rows = [[name, *(_mean(_of(figures, row=name), m) for m in _METRICS)] for name in LOSSES if _of(figures, row=name)]
    return _markdown(["losses", *map(str.upper, _METRICS)], rows)


def scenes_table(figures: Sequence[Figures]) -> str:
    """Every row of every scene and speed, means over seeds with the standard deviation of PSNR where there are more."""
    errors_of_poses = ("RE before", "RE after", "TE before", "TE after")
    header = ["scene", "speed", "row", "seeds", *map(str.upper, _METRICS), *errors_of_poses]
    rows = []
    for scene, speed, row in dict.fromkeys((one["scene"], one["speed"], one["row"]) for one in figures):
        some = _of(figures, scene=scene, speed=speed, row=row)
        cells = [_mean(some, metric) for metric in _METRICS]
        if len(some) > 1:
            cells[0] += f" ± {stdev(one['results']['psnr'] for one in some):.2f}"
        errors = [one["results"].get("pose_errors") for one in some]
        poses = [
            f"{fmean(error[which][key] for error in errors):.3f}{unit}" if all(errors) else "n/a"
            for key, unit in (("rotation_error_degrees", "°"), ("translation_error_percent", " %"))
            for which in ("estimated", "corrected")
        ]
        rows.append([scene, speed, row, str(len(some)), *cells, *poses])
    return _markdown(header, rows)


def _conditions(figures: Sequence[Figures]) -> str:
    """Where and how the figures were made."""
    lines = []
    for one in {(str(one["machine"]), str(one["versions"]), one["commit"]): one for one in figures}.values():
        machine, versions = one["machine"], ", ".join(f"{name} {number}" for name, number in one["versions"].items())
        device = f"{machine['gpu'] or machine['cpu']}, {machine['cores']} cores"
        lines.append(f"- {device}; {versions}; commit {one['commit']}")
    used = {one["results"].get("color_correction", "none (nerfacto)") for one in figures}
    lines.append(f"- colour correction: {'; '.join(sorted(used))}")
    return "\n".join(lines)


def _of(figures: Sequence[Figures], **wanted: str) -> list[Figures]:
    return [one for one in figures if all(one[key] == value for key, value in wanted.items())]


def _mean(figures: Sequence[Figures], metric: str) -> str:
    values = [one["results"].get(metric) for one in figures]
    if not values or None in values:
        return "n/a"
    return f"{fmean(values):.2f}" if metric == "psnr" else f"{fmean(values):.3f}"


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
