"""The page of a report: one HTML file that needs no network."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import jinja2
import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image, ImageOps
from plotly.offline import get_plotlyjs

from aenerf_ns.report import plots, sections
from aenerf_ns.report.measuring import RunReport
from aenerf_ns.report.sections import VIEW_COLUMNS, describe_run, view_rows
from aenerf_ns.report.view_pictures import ERROR_RANGE

# Maximum width of a picture in pixels, and JPEG quality.
_MAX_WIDTH, _QUALITY = 480, 88


def make_page(
    reports: Sequence[RunReport],
    paired: Sequence[Mapping[str, Any]],
    left_out: Mapping[str, Sequence[str]],
    mixed: Sequence[str],
    shared: Sequence[str],
) -> str:
    """Make the HTML of a report of one or more runs.

    ``paired``, ``left_out``, ``mixed`` and ``shared`` are what :mod:`~aenerf_ns.report.comparison` finds:
    ``paired_differences``, ``views_left_out``, ``protocol_differences`` and ``shared_views``.
    """
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"plot": _plot, "picture": _picture, "digits": lambda value, digits: f"{value:.{digits}f}"}
    template = environment.from_string(files("aenerf_ns.report").joinpath("page.html").read_text("utf8"))
    rows = view_rows(reports)
    different_data: dict[tuple, RunReport] = {}
    for report in reports:
        key = report.config["data"], *report.config["window_ns"]
        # Runs of some methods have no account of pairs.
        if key not in different_data or (different_data[key].num_pairs is None and report.num_pairs is not None):
            different_data[key] = report
    return template.render(
        reports=reports,
        descriptions=[describe_run(report) for report in reports],
        different_data=different_data.values(),
        # Runs without a view in common are shown one after the other.
        view_groups=[reports] if shared else [[report] for report in reports],
        view_rows=rows,
        view_columns={name: VIEW_COLUMNS[name] for name in VIEW_COLUMNS if any(row[name] is not None for row in rows)},
        paired=paired,
        left_out=left_out,
        mixed=mixed,
        shared=shared,
        words=sections,
        error_range=ERROR_RANGE,
        plots=plots,
        plotly=Markup(get_plotlyjs()),
    )


def _plot(figure: go.Figure | None, otherwise: str = "") -> Markup:
    """Draw a figure, or say why there is none."""
    if figure is None:
        return Markup("<p>{}</p>").format(otherwise)
    config = {"displayModeBar": False, "responsive": True}
    return Markup(figure.to_html(full_html=False, include_plotlyjs=False, config=config))


def _picture(values: Image.Image | NDArray[np.uint8], max_width: int = _MAX_WIDTH) -> str:
    """Encode a picture as a data URL."""
    image = Image.fromarray(values) if isinstance(values, np.ndarray) else values
    # Smaller pictures keep their size.
    image = ImageOps.contain(image, (max_width, image.height), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=_QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"
