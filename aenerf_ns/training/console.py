"""What training prints: losses, pose errors and thresholds beside Nerfstudio's times."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import timedelta
from typing import Any

from nerfstudio.configs.base_config import LocalWriterConfig
from nerfstudio.utils.printing import human_format
from nerfstudio.utils.writer import LocalWriter

from aenerf_ns.training.framework import logged_events, progress

# Names of the losses and metrics of a step in Nerfstudio's log, and the columns' headings.
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
_ETA = "ETA (time)"
_TIME_HEADINGS = {"Train Iter (time)": "Step time"}
_MIN_WIDTH = 10


class ConsoleWriter(LocalWriter):
    """Prints a line for each logged step, and the headings whenever there is a new one.

    A figure that a step lacks keeps its last value: the errors of the poses are measured every 100 steps.

    Args:
        config: of Nerfstudio's writer. Its ``stats_to_track`` can name Nerfstudio's own figures only.
        banner_messages: lines to begin with, such as the viewer's address.
    """

    def __init__(self, config: LocalWriterConfig, banner_messages: list[str] | None = None) -> None:
        super().__init__(config, banner_messages)
        self._latest: dict[str, str] = {}
        for message in banner_messages or ():
            print(message)

    def write_stats_log(self, step: int) -> None:
        """Print the line of the latest step, if its losses are logged. ``step`` may be another one's."""
        events = logged_events()
        if _LOSS not in events:
            return
        latest_step, share = progress()
        figures = {"Step (% Done)": f"{latest_step} ({share:.2%})", **self._figures(events)}
        has_new_heading = not figures.keys() <= self._latest.keys()
        self._latest |= figures
        widths = [max(len(heading), _MIN_WIDTH) for heading in self._latest]
        for texts in (self._latest.keys(), self._latest.values()) if has_new_heading else (self._latest.values(),):
            print("  ".join(f"{text:<{width}}" for text, width in zip(texts, widths, strict=True)))

    def _figures(self, events: Mapping[str, Any]) -> dict[str, str]:
        """Return the figures of a step by heading, the losses first."""
        figures = {"Loss": f"{float(events[_LOSS]):.4g}"}
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
        for name in self.stats_to_track:
            if name == _ETA and name in events:
                figures["ETA"] = str(timedelta(seconds=round(events[name])))
            elif "(time)" in name and name in events:
                figures[_TIME_HEADINGS.get(name, name)] = f"{events[name]:.3g} s"
            elif name in events:
                figures[name] = human_format(events[name]) if "Rays" in name else f"{float(events[name]):.4g}"
        return figures
