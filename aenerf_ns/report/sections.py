"""What the sections of a report say: sentences, and the columns of tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from aenerf_ns.report.measuring import RunReport

METRIC_DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}
"""Decimals of the image metrics."""
VIEW_COLUMNS = {
    "time_ns": ("time (s)", 3, 1e-9),
    "camera_speed": ("camera speed (units/s)", 3, 1),
    "camera_turn_rate_degrees": ("turn rate (°/s)", 1, 1),
    **{f"{name}_placed": (name.upper(), digits, 1) for name, digits in METRIC_DIGITS.items()},
    **{f"{name}_refined": (f"{name.upper()}, refined", digits, 1) for name, digits in METRIC_DIGITS.items()},
}
"""Figures of a view: the heading of their column, their decimals, and the factor that they are shown with."""
_UNKNOWN = "not recorded"


def describe_run(report: RunReport) -> dict[str, str]:
    """Describe what a run is and how it was made, by the headings of the table's rows."""
    record, config = report.record, report.config
    positive, negative = config["thresholds"]
    description = {
        "state": "not recorded: the run was made by an earlier version" if record is None else record.describe_state(),
        "data": config["data"],
        "sensor": f"{config['sensor']}, C+ {positive:g}, C− {negative:g}",
        "method": f"{config['method']}, {config['supervision']}, pose correction: {config['pose_correction']}",
        "seed": str(config["seed"]),
        **dict.fromkeys(("command", "commit", "versions", "machine", "training took", "peak memory"), _UNKNOWN),
        "folder": str(report.folder),
    }
    if record is not None:
        description["command"] = record.command or _UNKNOWN
        description["commit"] = record.commit or _UNKNOWN
        description["versions"] = ", ".join(f"{name} {number}" for name, number in record.versions.items()) or _UNKNOWN
        description["training took"] = f"{record.seconds:.0f} s, begun {record.started}"
        if record.machine is not None:
            machine = record.machine
            description["machine"] = f"{machine.cpu}, {machine.cores} cores, {machine.gpu or 'no GPU'}"
        sizes = [f"{size / 2**30:.2f} GiB ({part})" for part, size in record.peak_memory_bytes.items() if size]
        description["peak memory"] = ", ".join(sizes) or _UNKNOWN
    return description


def state_verdict(report: RunReport) -> list[str]:
    """Say in sentences what a run came to."""
    found, lines = report.evaluation, []
    if report.views:
        lines.append(f"{_describe_metrics(found)} (mean ± standard deviation of {len(report.views)} test views).")
        lines.append(f"The test cameras are placed by: {found['test_poses']}. Colors: {found['color_correction']}.")
        if "color_correction_slope" in found:
            slopes = ", ".join(f"{slope:+.2f}" for slope in found["color_correction_slope"])
            lines.append(f"Slope of the colors over the rendered log-radiance: {slopes}.")
        if "refined_test_poses" in found:
            lines.append(
                f"With test cameras that are refined photometrically, which looks at the test images: "
                f"{_describe_metrics(found['refined_test_poses'])}."
            )
    if report.contrast:
        names = ("red", "green", "blue") if len(report.contrast) == 3 else ("luminance",)
        shares = ", ".join(f"{name} {share:.2f}" for name, share in zip(names, report.contrast, strict=True))
        lines.append(
            f"Contrast of the rendered log-radiance, as a share of that of the images shown below: {shares}. 1 is "
            "right; less means that events were missed, that the thresholds are stated too low, or that the run was "
            "short."
        )
    errors, evo = found.get("pose_errors"), report.poses.evo
    if errors and evo:
        before, after = errors["estimated"], errors["corrected"]
        lines.append(
            f"Pose errors: {before['rotation_error_degrees']:.2f}° and {before['translation_error']:.4g} units of the "
            f"recording before training, {after['rotation_error_degrees']:.2f}° and {after['translation_error']:.4g} "
            f"after (means after alignment); absolute trajectory error {evo['estimated']['ate']['rmse']:.4g} "
            f"before, {evo['corrected']['ate']['rmse']:.4g} after."
        )
    diagnosis = found.get("pose_diagnosis")
    if diagnosis:
        lines.append(diagnosis["summary"])
    if report.missing:
        lines.append(f"Not measured: {' '.join(report.missing)}")
    return lines


def _describe_metrics(metrics: Mapping[str, Any]) -> str:
    parts = []
    for name, digits in METRIC_DIGITS.items():
        value, spread = metrics.get(name), metrics.get(f"{name}_std")
        if value is not None:
            unit = " dB" if name == "psnr" else ""
            parts.append(f"{name.upper()} {value:.{digits}f}" + (f" ± {spread:.{digits}f}" if spread else "") + unit)
    return ", ".join(parts)


def describe_events(report: RunReport) -> str:
    """Describe the events of a recording, which are still there, and the gaps between its poses."""
    assert report.check is not None
    events, gaps = report.check.statistics, report.pose_gaps_ns
    seconds = (events.end - events.start) * 1e-9
    lost = sum(last - first for first, last in gaps) * 1e-9
    share = events.num_positive / max(events.num_events, 1)
    described = f"{len(gaps)} gaps of the poses, {lost:.3f} s in all, in red." if gaps else "No gap of the poses."
    return f"{events.num_events:,} events in {seconds:.3f} s, {share:.1%} positive. {described}"


def view_rows(reports: Sequence[RunReport]) -> list[dict[str, Any]]:
    """List the test views of all runs with their figures, None where one is not known."""
    rows = []
    for report in reports:
        for view in report.views:
            row = {"run": report.name}
            row |= {name: view[name] for name in ("file", "time_ns", "camera_speed", "camera_turn_rate_degrees")}
            for protocol in ("placed", "refined"):
                row |= {f"{name}_{protocol}": view.get(protocol, {}).get(name) for name in METRIC_DIGITS}
            rows.append(row)
    return rows
