"""The table that training prints: losses, pose errors and thresholds beside the framework's times."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nerfstudio.configs.base_config import LocalWriterConfig
from nerfstudio.utils.decorators import check_main_thread, decorate_all
from nerfstudio.utils.printing import human_format
from nerfstudio.utils.writer import LocalWriter, _format_time

# Names of the losses and metrics of a step in the framework's log, and the columns' headings.
_LOSS, _LOSSES, _METRICS, _VIEW = "Train Loss", "Train Loss Dict", "Train Metrics Dict", "Eval Images Metrics"
_LOSS_HEADINGS = {"pose_correction_penalty": "Penalty"}
_METRIC_HEADINGS = {
    "polarity_agreement": "Polarity",
    "pose_correction_degrees": "Turned (°)",
    "rotation_error_degrees": "Error (°)",
    "translation_error": "Error (length)",
    "contrast_threshold_ratio": "C+/C-",
    "refractory_period_ns": "Refractory (ns)",
    "clock_offset_seconds": "Clock (s)",
    "pairs_per_second": "Pairs/s",
}
_TIME_HEADINGS = {"Train Iter (time)": "Step time", "ETA (time)": "ETA"}
_WIDTHS = {"ETA": 18}


class _Row(str):
    """Figures of a row, which the framework formats as if they were a number."""

    def __format__(self, specification: str) -> str:
        return str(self)


@decorate_all([check_main_thread])
class ConsoleWriter(LocalWriter):
    """The framework's writer to the console, with each loss and what tells most of a training.

    A figure that a row lacks keeps its last value: the errors of the poses are measured every 100 steps.

    Args:
        config: of the framework's writer. Its ``stats_to_track`` can name the framework's own figures only.
        banner_messages: lines at the bottom of the table.
    """

    stats_to_track: list[str]

    def __init__(self, config: LocalWriterConfig, banner_messages: list[str] | None = None) -> None:
        super().__init__(config, banner_messages)
        self._of_framework = tuple(self.stats_to_track)
        self._latest: dict[str, str] = {}

    def _consolidate_events(self) -> tuple[dict[str, Any], bool]:
        """Return the row under its headings, and whether a heading is new."""
        events, _ = super()._consolidate_events()
        figures = self._figures(events)
        has_new = not figures.keys() <= self._latest.keys()
        self._latest |= figures
        widths = {heading: max(len(heading), _WIDTHS.get(heading, 10)) for heading in self._latest}
        headings = "  ".join(f"{heading:<{widths[heading]}}" for heading in self._latest)
        row = "  ".join(f"{figure:<{widths[heading]}}" for heading, figure in self._latest.items())
        # All columns are one to the framework, because it makes each 20 characters wide.
        self.stats_to_track = [headings]
        return {headings: _Row(row)}, has_new

    def _figures(self, events: Mapping[str, Any]) -> dict[str, str]:
        """Return the figures of a step by heading, the losses first."""
        figures = {"Loss": f"{float(events[_LOSS]):.4g}"} if _LOSS in events else {}
        for name, loss in events.get(_LOSSES, {}).items():
            heading = _LOSS_HEADINGS.get(name, name.removesuffix("_loss").replace("_", " ").capitalize())
            figures[heading] = f"{float(loss):.4g}"
        metrics = events.get(_METRICS, {})
        for name, heading in _METRIC_HEADINGS.items():
            if name in metrics:
                figure = float(metrics[name])
                figures[heading] = human_format(figure) if name == "pairs_per_second" else f"{figure:.4g}"
        if "psnr" in events.get(_VIEW, {}):
            figures["Val. PSNR"] = f"{float(events[_VIEW]['psnr']):.4g}"
        for name in self._of_framework:
            if name not in events:
                continue
            if "(time)" in name:
                figures[_TIME_HEADINGS.get(name, name)] = _format_time(events[name])
            else:
                figures[name] = human_format(events[name]) if "Rays" in name else f"{float(events[name]):.4g}"
        return figures
