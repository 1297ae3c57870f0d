"""The plots of a report, by plotly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from aenerf_ns.report.measuring import RunReport
from aenerf_ns.report.pair_residuals import PairResiduals

# Colors of the runs and of true poses.
_COLORS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf")
_TRUE = "#999999"
# A loss that vanishes for some steps must not press the rest of its curve together.
_MAX_DECADES = 5

# Panels of the curves: the scalar's name, its title, and whether the axis is logarithmic.
_CURVES = (
    ("Train Loss Dict/reconstruction_loss", "reconstruction loss (1: no change rendered, consecutive events)", True),
    ("Train Loss Dict/temporal_loss", "temporal loss, weighted", True),
    ("Train Loss Dict/interlevel_loss", "proposal loss, weighted", True),
    ("Train Loss Dict/distortion_loss", "distortion loss, weighted", True),
    ("Train Loss Dict/pose_correction_penalty", "penalty on corrections", True),
    ("Train Metrics Dict/polarity_agreement", "pairs with the sign of the events (share)", False),
    ("Eval Images Metrics/psnr", "PSNR of one validation view (dB)", False),
    ("Eval Images Metrics Dict (all images)/psnr", "PSNR of all validation views (dB)", False),
    ("Train Metrics Dict/rotation_error_degrees", "rotation error (degrees)", False),
    ("Train Metrics Dict/translation_error", "translation error (recording units)", False),
    ("Train Metrics Dict/pose_correction_degrees", "size of the corrections (degrees)", False),
    ("Train Metrics Dict/contrast_threshold_ratio", "C+ / C−, learned", False),
    ("Train Metrics Dict/refractory_period_ns", "refractory period, learned (ns)", False),
    ("Train Metrics Dict/clock_offset_seconds", "clock offset, learned (s)", False),
)


def color(index: int) -> str:
    """Return the color of a run."""
    return _COLORS[index % len(_COLORS)]


def curves(reports: Sequence[RunReport]) -> go.Figure | None:
    """Plot the logged losses and figures over the steps; None where no run kept any."""
    kept = [report.scalars or {} for report in reports]
    panels = [panel for panel in _CURVES if any(panel[0] in scalars for scalars in kept)]
    if not panels:
        return None
    columns = 2
    rows = -(-len(panels) // columns)
    titles = [title for _, title, _ in panels]
    figure = make_subplots(rows, columns, subplot_titles=titles, vertical_spacing=0.25 / rows)
    for index, (name, _, logarithmic) in enumerate(panels):
        row, column = index // columns + 1, index % columns + 1
        for run, (report, scalars) in enumerate(zip(reports, kept, strict=True)):
            if name in scalars:
                show = len(reports) > 1 and index == 0
                _add_line(figure, *scalars[name], report.name, {"color": color(run)}, show, row, column)
        figure.update_yaxes(exponentformat="power", row=row, col=column)
        if logarithmic:
            logged = [value for scalars in kept for value in scalars.get(name, ([], []))[1] if value > 0]
            figure.update_yaxes(type="log", range=_decades(logged), row=row, col=column)
    last = max(steps[-1] for scalars in kept for steps, _ in scalars.values())
    figure.update_xaxes(range=[0, last])
    figure.update_xaxes(title_text="step", row=rows)
    return _style(figure, 210 * rows + 60)


def _decades(values: Sequence[float]) -> list[float] | None:
    """Return the ends of a logarithmic axis: of all values, but no more than some decades below the highest."""
    if not values:
        return None
    low, high = np.log10([min(values), max(values)])
    margin = 0.05 * (min(high - low, _MAX_DECADES) + 0.1)
    return [max(low, high - _MAX_DECADES) - margin, high + margin]


def event_rate(report: RunReport) -> go.Figure:
    """Plot the rate of the events over time, with the gaps of the poses."""
    assert report.check is not None
    events = report.check.statistics
    start, end, rate = events.start * 1e-9, events.end * 1e-9, report.check.events_per_second
    times = np.linspace(start, end, len(rate), endpoint=False) + (end - start) / len(rate) / 2
    figure = go.Figure(go.Bar(x=times, y=rate, marker_color=color(0), width=(end - start) / len(rate)))
    for first, last in report.pose_gaps_ns:
        figure.add_vrect(first * 1e-9, last * 1e-9, fillcolor="#d62728", opacity=0.2, line_width=0)
    figure.update_layout(xaxis_title="time (s), clock of the events", yaxis_title="events a second", bargap=0)
    return _style(figure, 260)


def trajectory(reports: Sequence[RunReport]) -> go.Figure:
    """Plot the trajectories from above and from the side: the recording's world, turned upright, and its units."""
    figure = make_subplots(1, 2, subplot_titles=("from above", "from the side"))
    # One for all: runs on the same true poses may have scenes that are turned otherwise.
    upright = np.array(reports[0].poses.upright)
    for column, (across, up) in enumerate(((0, 1), (0, 2)), start=1):
        for run, report in enumerate(reports):
            for name, points in _paths(report, reports[:run]):
                x, y = (np.array(points) @ upright.T).T[[across, up]]
                shown = name if len(reports) == 1 or name == "true" else f"{name}, {report.name}"
                _add_line(figure, x, y, shown, _line(name, run), column == 1, 1, column)
        figure.update_xaxes(title_text="x", row=1, col=column)
        figure.update_yaxes(title_text="xyz"[up], scaleanchor=f"x{column if column > 1 else ''}", row=1, col=column)
    return _style(figure, 460)


def _paths(report: RunReport, drawn: Sequence[RunReport]) -> list[tuple[str, Any]]:
    positions = report.poses.positions
    # All runs of a comparison have the same true poses, as far as they have any.
    is_drawn = any("true" in other.poses.positions for other in drawn)
    shown = [(name, points) for name, points in positions.items() if name != "true" or not is_drawn]
    # Below the others.
    return sorted(shown, key=lambda path: path[0] != "true")


def _add_line(
    figure: go.Figure, x: Sequence[float], y: Sequence[float], name: str, line: dict[str, Any], show: bool, row: int,
    column: int,
) -> None:  # fmt: skip
    """Add a line, or its only point, to a panel. ``show`` puts it in the legend."""
    mode = "lines" if len(x) > 1 else "markers"
    figure.add_scatter(
        x=x, y=y, name=name, line=line, mode=mode, legendgroup=name, showlegend=show, row=row, col=column
    )


def _line(name: str, run: int) -> dict[str, Any]:
    if name == "true":
        return {"color": _TRUE, "width": 3}
    return {"color": color(run), "width": 1.5, "dash": "dot" if name == "estimated" else "solid"}


def pose_errors(reports: Sequence[RunReport]) -> go.Figure | None:
    """Plot rotation and translation errors over time; None where no true poses are known."""
    known = [(run, report) for run, report in enumerate(reports) if report.poses.errors]
    if not known:
        return None
    titles = {"rotation_degrees": "rotation error (degrees)", "translation": "translation error (recording units)"}
    figure = make_subplots(2, 1, subplot_titles=list(titles.values()), shared_xaxes=True, vertical_spacing=0.12)
    for row, kind in enumerate(titles, start=1):
        for run, report in known:
            for name, errors in (report.poses.errors or {}).items():
                shown = name if len(reports) == 1 else f"{name}, {report.name}"
                _add_line(figure, report.poses.seconds, errors[kind], shown, _line(name, run), row == 1, row, 1)
    figure.update_xaxes(title_text="seconds since the start of the trajectory", row=2)
    figure.update_yaxes(rangemode="tozero")
    return _style(figure, 480)


def correction(reports: Sequence[RunReport]) -> go.Figure | None:
    """Plot the six components of the correction ψ over time; None where no run corrects poses."""
    known = [(run, report, report.poses.correction) for run, report in enumerate(reports) if report.poses.correction]
    if not known:
        return None
    names = list(known[0][2])
    titles = [f"{name} ({'degrees' if 'rotation' in name else 'recording units'})" for name in names]
    figure = make_subplots(2, 3, subplot_titles=titles, shared_xaxes=True, vertical_spacing=0.14)
    for index, name in enumerate(names):
        for run, report, components in known:
            show, line = len(known) > 1 and index == 0, {"color": color(run)}
            x, y = report.poses.seconds, components[name]
            _add_line(figure, x, y, report.name, line, show, index // 3 + 1, index % 3 + 1)
    figure.update_xaxes(title_text="seconds", row=2)
    return _style(figure, 440)


def changes(pairs: PairResiduals) -> go.Figure:
    """Plot the 2-D histogram of rendered against measured changes."""
    edges = np.array(pairs.edges)
    middles = (edges[1:] + edges[:-1]) / 2
    counts = np.array(pairs.histogram)
    # Nothing is drawn where there are no pairs.
    shown = [[float(np.log10(count)) if count else None for count in row] for row in counts]
    figure = go.Figure(
        go.Heatmap(
            x=middles, y=middles, z=shown, customdata=counts, colorscale="Viridis",
            hovertemplate="measured %{x:.1f}, rendered %{y:.1f}: %{customdata} pairs<extra></extra>",
            colorbar={"title": "pairs", "tickvals": [0, 1, 2, 3, 4], "ticktext": ["1", "10", "100", "1000", "10⁴"]},
        )
    )  # fmt: skip
    figure.add_scatter(x=edges[[0, -1]], y=edges[[0, -1]], mode="lines", line={"color": "#d62728", "dash": "dot"})
    figure.update_xaxes(title_text="measured change (thresholds)", constrain="domain")
    figure.update_yaxes(title_text="rendered change (thresholds)", scaleanchor="x", constrain="domain")
    figure.update_layout(showlegend=False)
    return _style(figure, 440)


def residual_by_length(reports: Sequence[RunReport]) -> go.Figure:
    """Plot the mean absolute residual by the number of events of a pair."""
    figure = go.Figure()
    names: set[str] = set()
    for run, report in enumerate(reports):
        if report.pairs is not None:
            rows = report.pairs.by_length
            names |= {row["events"] for row in rows}
            figure.add_bar(
                x=[row["events"] for row in rows], y=[row["mean_residual"] for row in rows], name=report.name,
                marker_color=color(run), customdata=[row["num_pairs"] for row in rows],
                hovertemplate="%{x} events: %{y:.3f} thresholds, %{customdata} pairs<extra></extra>",
            )  # fmt: skip
    figure.update_layout(
        xaxis={"title": "events of a pair", "categoryarray": sorted(names, key=lambda name: int(name.split()[0]))},
        xaxis_type="category", yaxis_title="mean |rendered − measured| (thresholds)", showlegend=len(reports) > 1,
    )  # fmt: skip
    return _style(figure, 440)


def residual_by_tile(pairs: PairResiduals) -> go.Figure:
    """Plot the mean absolute residual by tile of the sensor."""
    tiles = pairs.by_tile
    highest = max((value for row in tiles for value in row if value is not None), default=1.0)
    figure = go.Figure(
        go.Heatmap(
            z=tiles, colorscale="Viridis", zmin=0, zmax=highest, colorbar={"title": "thresholds"},
            hovertemplate="%{z:.3f} thresholds<extra></extra>",
        )
    )  # fmt: skip
    figure.update_yaxes(autorange="reversed", scaleanchor="x", constrain="domain", showticklabels=False)
    figure.update_xaxes(constrain="domain", showticklabels=False)
    return _style(figure, 440)


def _style(figure: go.Figure, height: int) -> go.Figure:
    top, bottom = 40, 70
    figure.update_layout(
        height=height, template="plotly_white", margin={"l": 60, "r": 20, "t": top, "b": bottom}, font={"size": 12},
        # Below the title of the lowest axis, however high the plot is.
        legend={"orientation": "h", "yanchor": "top", "y": -45 / (height - top - bottom)},
    )  # fmt: skip
    figure.update_annotations(font_size=12)
    return figure
