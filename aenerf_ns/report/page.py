"""The page of a report: one file that needs no network."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import plotly.graph_objects as go
from PIL import Image
from plotly.offline import get_plotlyjs

from aenerf_ns.report import plots
from aenerf_ns.report.measuring import RunReport
from aenerf_ns.report.sections import account, differences, header, verdict, view_table
from aenerf_ns.report.view_pictures import ERROR_RANGE

# Wider pictures are scaled down, and so much loss is not seen.
_WIDEST, _QUALITY = 480, 88


def make_page(
    reports: Sequence[RunReport], paired: Sequence[dict[str, Any]], mixed: Sequence[str], shared: Sequence[str]
) -> str:
    """Return the HTML of a report.

    Args:
        reports: of one or more runs.
        paired: see :func:`~aenerf_ns.report.comparison.paired_differences`.
        mixed: how the runs were measured differently, in words.
        shared: the files of the views that all runs have.
    """
    sections: list[tuple[str, str]] = [
        ("Runs" if len(reports) > 1 else "Run", header(reports)),
        ("Verdict", verdict(reports) + differences(reports, paired, shared)),
        ("Data", "".join(_data(report) for report in _of_different_data(reports))),
        ("Curves", _plot(plots.curves(reports), "No run kept its scalars.")),
        ("Views", _views(reports, shared)),
        ("Poses", _poses(reports)),
        ("Events, rendered and measured", _pairs(reports)),
        ("Not measured", account(reports)),
    ]
    title = f"Report: {', '.join(report.name for report in reports)}"
    links = "".join(f'<a href="#section{number}">{escape(name)}</a>' for number, (name, _) in enumerate(sections))
    warning = ""
    if mixed:
        lines = "".join(f"<li>{escape(line)}</li>" for line in mixed)
        said = "<b>These runs were measured differently. Do not compare their means.</b>"
        warning = f'<div class="warning">{said}<ul>{lines}</ul></div>'
    body = f"<h1>{escape(title)}</h1><nav>{links}</nav>{warning}" + "".join(
        f'<h2 id="section{number}">{escape(name)}</h2>{content}' for number, (name, content) in enumerate(sections)
    )
    template = Template(files("aenerf_ns.report").joinpath("page.html").read_text("utf8"))
    return template.substitute(title=escape(title), plotly=get_plotlyjs(), body=body)


def _plot(figure: go.Figure | None, otherwise: str = "") -> str:
    if figure is None:
        return f"<p>{escape(otherwise)}</p>"
    return figure.to_html(full_html=False, include_plotlyjs=False, config={"displayModeBar": False, "responsive": True})


def _of_different_data(reports: Sequence[RunReport]) -> list[RunReport]:
    seen: dict[tuple, RunReport] = {}
    for report in reports:
        seen.setdefault((report.config["data"], *report.config["window_ns"]), report)
    return list(seen.values())


def _data(report: RunReport) -> str:
    data = report.data
    parts = [f"<h3>{escape(report.config['data'])}</h3>"]
    if "num_events" in data:
        share = data["num_positive"] / max(data["num_events"], 1)
        seconds = (data["end_ns"] - data["start_ns"]) * 1e-9
        gaps = data["pose_gaps_ns"]
        lost = sum(last - first for first, last in gaps) * 1e-9
        parts.append(
            f"<p>{data['num_events']:,} events in {seconds:.3f} s, {share:.1%} positive. "
            + (f"{len(gaps)} gaps of the poses, {lost:.3f} s in all, in red." if gaps else "No gap of the poses.")
            + "</p>"
        )
        parts.append(_plot(plots.event_rate(report)))
    if "pairs" in data:
        parts.append(f"<p>Pairs: {escape(data['pairs'])}.</p>")
    if data["problems"]:
        lines = "".join(f"<li>{escape(line)}</li>" for line in data["problems"])
        parts.append(f'<div class="warning"><b>aenerf check found problems:</b><ul>{lines}</ul></div>')
    elif data["check"]:
        parts.append("<p>aenerf check found no problems.</p>")
    if report.check_picture is not None:
        parts.append(
            f'<figure class="check">{_image(report.check_picture, 960)}<figcaption>Left: events as they came. Right: '
            "the same events, warped to one view by the poses that the run was given.</figcaption></figure>"
        )
    if data["check"]:
        lines = escape("\n".join(data["check"]))
        parts.append(f"<details><summary>All that aenerf check says</summary><pre>{lines}</pre></details>")
    return "".join(parts)


def _views(reports: Sequence[RunReport], shared: Sequence[str]) -> str:
    if not any(report.pictures for report in reports):
        return "<p>There are no views with images.</p>"
    parts = [
        f"<p>The mean absolute difference of display values in [0, 1] is shown from 0 (black) to {ERROR_RANGE:g} "
        "(brightest). The cameras are as placed. Depth is along the ray, in units of the recording.</p>"
    ]
    named = len(reports) > 1
    # Runs without a view in common are shown one after the other.
    for group in [reports] if shared else [[report] for report in reports]:
        for file, reason in group[0].chosen.items():
            rows = "".join(_view(report, file, named) for report in group)
            parts.append(f'<div class="view"><h3>{escape(file)} ({reason})</h3>{rows}</div>')
    return "".join(parts) + view_table(reports)


def _view(report: RunReport, file: str, named: bool) -> str:
    pictures = report.pictures[file]
    metrics = next(view["placed"] for view in report.views if view["file"] == file)
    near, far = pictures.depth_range
    captions = {
        "truth": "truth",
        "rendering": f"rendering: PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim']:.3f}",
        "error": f"error, 0 to {ERROR_RANGE:g}",
        "depth": f"depth, {near:.2f} to {far:.2f}",
    }
    shown = "".join(
        f"<figure>{_image(getattr(pictures, kind))}<figcaption>{caption}</figcaption></figure>"
        for kind, caption in captions.items()
    )
    return (f"<div>{escape(report.name)}</div>" if named else "") + f'<div class="pictures">{shown}</div>'


def _poses(reports: Sequence[RunReport]) -> str:
    rows = []
    for report in reports:
        for name, kinds in (report.poses["evo"] or {}).items():
            for kind, values in kinds.items():
                cells = "".join(f'<td class="number">{value:.4g}</td>' for value in values.values())
                rows.append(
                    f"<tr><td>{escape(report.name)}</td><td>{name}</td><td>{kind.replace('_', ' ')}</td>"
                    f'<td class="number">{report.poses["num_poses"]}</td>{cells}</tr>'
                )
    parts = [
        "<p>In units of the recording, aligned to the true trajectory by Sim(3) where it is known. z points up as far "
        "as the cameras tell.</p>",
        _plot(plots.trajectory(reports)),
    ]
    if rows:
        heads = "".join(
            f'<th class="number">{name}</th>' for name in ("max", "mean", "median", "min", "rmse", "sse", "std")
        )
        parts.append(
            "<h3>Absolute and relative errors, as evo_ape and evo_rpe print them with -as</h3>"
            '<div class="scroll"><table><thead><tr><th>run</th><th>poses</th><th>error</th>'
            f'<th class="number">number</th>{heads}</tr></thead>'
            f"<tbody>{''.join(rows)}</tbody></table></div>"
            '<p class="small">Over all given poses that the true ones cover. Relative errors are from each of these '
            "poses to the next. They grow with the distance between the poses.</p>"
        )
    parts.append(
        _plot(plots.pose_errors(reports), "The errors of the poses are not known: the recording has no true poses.")
    )
    parts.append("<h3>The correction ψ over time, in the camera's frame</h3>")
    parts.append(_plot(plots.correction(reports), "No run corrects poses."))
    return "".join(parts)


def _pairs(reports: Sequence[RunReport]) -> str:
    known = [report for report in reports if report.pairs is not None]
    if not known:
        return "<p>Not measured.</p>"
    parts = [
        "<p>Newly drawn pairs of events of a pixel: the change of log-radiance that the events tell of, and the change "
        "that the field renders between the same two times, in contrast thresholds.</p>"
    ]
    for report in known:
        assert report.pairs is not None
        parts.append(
            f"<h3>{escape(report.name)}: {report.pairs['num_pairs']:,} pairs, correlation "
            f"{report.pairs['correlation']:.3f}, mean residual {report.pairs['mean_residual']:.3f} thresholds</h3>"
            f'<div class="beside"><div>{_plot(plots.changes(report))}</div>'
            f"<div>{_plot(plots.residual_by_tile(report))}"
            '<p class="small">Mean residual by tile of the sensor.</p></div></div>'
        )
    parts.append("<h3>Mean residual by the number of events of a pair</h3>" + _plot(plots.residual_by_length(reports)))
    return "".join(parts)


def _image(image: Image.Image, widest: int = _WIDEST) -> str:
    if image.width > widest:
        image = image.resize((widest, round(image.height * widest / image.width)), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=_QUALITY)
    return f'<img alt="" src="data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}">'
