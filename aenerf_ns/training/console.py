"""The table that training prints: the losses beside the framework's times."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nerfstudio.configs.base_config import LocalWriterConfig
from nerfstudio.utils.decorators import check_main_thread, decorate_all
from nerfstudio.utils.writer import LocalWriter

_LOSS = "Train Loss"
# Names of losses and metrics, and the headings of their columns, which the framework makes 20 characters wide.
_HEADINGS = {
    "reconstruction_loss": "Reconstruction",
    "polarity_agreement": "Polarity agreement",
    "pose_correction_degrees": "Poses turned (deg)",
}


@decorate_all([check_main_thread])
class ConsoleWriter(LocalWriter):
    """The framework's writer to the console, with the loss and what tells most of a training.

    Args:
        config: of the framework's writer. Its ``stats_to_track`` can name the framework's own figures only.
        banner_messages: lines at the bottom of the table.
    """

    stats_to_track: list[str]

    def __init__(self, config: LocalWriterConfig, banner_messages: list[str] | None = None) -> None:
        super().__init__(config, banner_messages)
        self.stats_to_track = [_LOSS, *_HEADINGS.values(), *self.stats_to_track]

    def _consolidate_events(self) -> tuple[dict[str, Any], bool]:
        """Return the figures of a row by heading, the losses first, and whether a heading is new."""
        latest, has_new = super()._consolidate_events()
        # First, because the framework leaves some of its own figures out of some rows.
        shown = {_LOSS: latest[_LOSS]} if _LOSS in latest else {}
        for figures in latest.values():
            if isinstance(figures, Mapping):
                shown |= {heading: figures[name] for name, heading in _HEADINGS.items() if name in figures}
        return {**shown, **latest}, has_new
