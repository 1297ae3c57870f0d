"""The tables and sentences of a report."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

from aenerf_ns.report.comparison import views_left_out
from aenerf_ns.report.measuring import RunReport
from aenerf_ns.report.plots import color
from aenerf_ns.report.run_files import describe_state

_UNKNOWN = "not recorded"
_DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}


def header(reports: Sequence[RunReport]) -> str:
    """Return the table that says what each run is and how it was made."""
    columns = [_header(report) for report in reports]
    names = "".join(
        f'<th><span class="swatch" style="background:{color(index)}"></span>{escape(report.name)}</th>'
        for index, report in enumerate(reports)
    )
    rows = "".join(
        f"<tr><th>{name}</th>{''.join(f'<td>{escape(column[name])}</td>' for column in columns)}</tr>"
        for name in columns[0]
    )
    top = f"<thead><tr><th></th>{names}</tr></thead>" if len(reports) > 1 else ""
    return f'<div class="scroll"><table class="header">{top}<tbody>{rows}</tbody></table></div>'


def _header(report: RunReport) -> dict[str, str]:
    record, config = report.record or {}, report.config
    positive, negative = config["thresholds"]
    machine, memory = record.get("machine", {}), record.get("peak_memory_bytes", {})
    gpu = f", {machine['gpu']}" if machine.get("gpu") else ", no GPU"
    sizes = [f"{memory[part] / 2**30:.2f} GiB ({part})" for part in ("host", "gpu") if memory.get(part)]
    return {
        "state": describe_state(report.record),
        "data": config["data"],
        "sensor": f"{config['sensor']}, C+ {positive:g}, C− {negative:g}",
        "method": f"{config['method']}, {config['supervision']}, pose correction: {config['pose_correction']}",
        "seed": str(config["seed"]),
        "command": record.get("command", _UNKNOWN),
        "commit": record.get("commit") or _UNKNOWN,
        "versions": ", ".join(f"{name} {number}" for name, number in record.get("versions", {}).items()) or _UNKNOWN,
        "machine": f"{machine['cpu']}, {machine['cores']} cores{gpu}" if machine else _UNKNOWN,
        "training took": f"{record['seconds']:.0f} s, begun {record['started']}" if record else _UNKNOWN,
        "peak memory": ", ".join(sizes) or _UNKNOWN,
        "folder": str(report.folder),
    }


def verdict(reports: Sequence[RunReport]) -> str:
    """Return what each run came to, in sentences."""
    return "".join(
        f'<div class="verdict" style="border-color:{color(index)}">'
        + (f"<b>{escape(report.name)}</b>" if len(reports) > 1 else "")
        + "".join(f"<p>{escape(line)}</p>" for line in _verdict(report))
        + "</div>"
        for index, report in enumerate(reports)
    )


def _verdict(report: RunReport) -> list[str]:
    found, lines = report.evaluation, []
    if report.views:
        placed = _metrics(found)
        lines.append(f"{placed} (mean ± standard deviation of {len(report.views)} test views).")
        lines.append(f"The test cameras are placed by: {found['test_poses']}. Colours: {found['color_correction']}.")
        if "refined_test_poses" in found:
            lines.append(
                f"With test cameras that are refined photometrically, which looks at the test images: "
                f"{_metrics(found['refined_test_poses'])}."
            )
    if report.contrast:
        names = ("red", "green", "blue") if len(report.contrast) == 3 else ("luminance",)
        shares = ", ".join(f"{name} {share:.2f}" for name, share in zip(names, report.contrast, strict=True))
        lines.append(
            f"Contrast of the rendered log-radiance, as a share of that of the images shown below: {shares}. 1 is "
            "right; less means that events were missed, that the thresholds are stated too low, or that the run was "
            "short."
        )
    errors, evo = found.get("pose_errors"), report.poses["evo"]
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


def _metrics(metrics: dict[str, Any]) -> str:
    parts = []
    for name, digits in _DIGITS.items():
        value, spread = metrics.get(name), metrics.get(f"{name}_std")
        if value is not None:
            unit = " dB" if name == "psnr" else ""
            parts.append(f"{name.upper()} {value:.{digits}f}" + (f" ± {spread:.{digits}f}" if spread else "") + unit)
    return ", ".join(parts)


def differences(reports: Sequence[RunReport], paired: Sequence[dict[str, Any]], shared: Sequence[str]) -> str:
    """Return the table of paired differences and what is left out of it, empty for a single run.

    Args:
        reports: of the runs.
        paired: see :func:`~aenerf_ns.report.comparison.paired_differences`.
        shared: the files of the views that all runs have.
    """
    if len(reports) < 2:
        return ""
    if not paired:
        return "<p>No test view is in all runs, so there are no paired differences.</p>"
    rows = []
    for row in paired:
        digits = _DIGITS[row["metric"]]
        interval = row["interval"]
        between = f"{interval[0]:+.{digits}f} to {interval[1]:+.{digits}f}" if interval else "one view only"
        clear = "yes" if interval and (interval[0] > 0 or interval[1] < 0) else "no"
        rows.append(
            f"<tr><td>{escape(row['run'])} − {escape(row['minus'])}</td><td>{row['metric'].upper()}</td>"
            f'<td>{row["test_poses"]}</td><td class="number">{row["num_views"]}</td>'
            f'<td class="number">{row["mean"]:+.{digits}f}</td><td class="number">{between}</td>'
            f"<td>{clear}</td></tr>"
        )
    return (
        "<h3>Paired differences on the same test views</h3><div class=scroll><table><thead><tr><th>runs</th>"
        "<th>metric</th><th>test poses</th><th class=number>views</th><th class=number>mean</th>"
        "<th class=number>95 % interval</th>"
        f"<th>zero is outside</th></tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
        '<p class="small">Student\'s t over the views. The interval says how far other views might differ, not other '
        f"seeds.</p>{_left_out(reports, shared)}"
    )


def _left_out(reports: Sequence[RunReport], shared: Sequence[str]) -> str:
    """Return which views are not in all runs."""
    left_out = views_left_out(reports, shared)
    if not left_out:
        return ""
    counts = ", ".join(f"{len(files)} of {escape(name)}" for name, files in left_out.items())
    lines = "".join(f"<li>{escape(name)}: {escape(', '.join(files))}</li>" for name, files in left_out.items())
    said = f"{len(shared)} test views are in all runs, as the same image of the same name. Left out: {counts}."
    return f"<details><summary>{said}</summary><ul>{lines}</ul></details>"


def view_table(reports: Sequence[RunReport]) -> str:
    """Return the table of all views, which is sorted by a click on a heading."""
    metrics = [
        (protocol, name)
        for protocol in ("placed", "refined")
        for name in _DIGITS
        if any(name in view.get(protocol, {}) for report in reports for view in report.views)
    ]
    heads = [("view", "")] + ([("run", "")] if len(reports) > 1 else [])
    # Columns that are empty in every line are left out.
    has = {
        name: any(view[name] is not None for report in reports for view in report.views)
        for name in ("time_ns", "camera_speed", "camera_turn_rate_degrees")
    }
    heads += [("time (s)", "number")] * has["time_ns"]
    heads += [(f"{name.upper()}{', refined' if protocol == 'refined' else ''}", "number") for protocol, name in metrics]
    heads += [("camera speed (units/s)", "number")] * has["camera_speed"]
    heads += [("turn rate (°/s)", "number")] * has["camera_turn_rate_degrees"]
    rows = []
    for report in reports:
        for view in report.views:
            cells = [f"<td>{escape(view['file'])}</td>"]
            if len(reports) > 1:
                cells.append(f"<td>{escape(report.name)}</td>")
            time = view["time_ns"]
            if has["time_ns"]:
                cells.append(_cell(None if time is None else time * 1e-9, 3))
            cells += [_cell(view.get(protocol, {}).get(name), _DIGITS[name]) for protocol, name in metrics]
            cells += [
                _cell(view[name], digits)
                for name, digits in (("camera_speed", 3), ("camera_turn_rate_degrees", 1))
                if has[name]
            ]
            rows.append(f"<tr>{''.join(cells)}</tr>")
    top = "".join(f'<th scope="col" class="{kind}">{name}</th>' for name, kind in heads)
    return (
        "<h3>All test views</h3><p class=small>A click on a heading sorts.</p><div class=scroll>"
        f'<table class="sortable"><thead><tr>{top}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    )


def _cell(value: float | None, digits: int) -> str:
    if value is None:
        return '<td class="number" data-value="">–</td>'
    return f'<td class="number" data-value="{value!r}">{value:.{digits}f}</td>'


def account(reports: Sequence[RunReport]) -> str:
    """Return what was not measured of each run, and why."""
    parts = []
    for report in reports:
        name = f"<h3>{escape(report.name)}</h3>" if len(reports) > 1 else ""
        lines = "".join(f"<li>{escape(line)}</li>" for line in report.missing) or "<li>Nothing is missing.</li>"
        parts.append(f"{name}<ul>{lines}</ul>")
    return "".join(parts)
