"""What ``aenerf check`` finds in a recording, as it is found."""

from __future__ import annotations

from dataclasses import dataclass, field

from aenerf_ns.checking.contrast import WarpedEvents
from aenerf_ns.events.statistics import EventStatistics


@dataclass
class CheckResult:
    """Collect what a check finds.

    Attributes:
        statistics: of all events.
        figures: what was measured, in words: a text for each figure.
        problems: what is wrong with the recording and what to do about it, a line for each problem.
        planes: options of training, by name: a near and a far plane in scene units for a camera that stays equally far
            from everything. Empty for a scene with a box, and where no depth is known.
        sensor_options: options of the dataset's format, by name: a threshold in place of a guessed one.
        warped: the warped events, or None if too few events have a pose.
    """

    statistics: EventStatistics
    figures: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    planes: dict[str, str] = field(default_factory=dict)
    sensor_options: dict[str, str] = field(default_factory=dict)
    warped: WarpedEvents | None = None

    @property
    def events_per_second(self) -> list[float]:
        """Rate of the events in equal parts of their time."""
        counted = self.statistics
        return (counted.rate * (len(counted.rate) / max(counted.end - counted.start, 1) * 1e9)).tolist()
