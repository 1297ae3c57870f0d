"""``aenerf export-frames``: rendered frames and depths along the trajectory of a trained run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.cli.operands import RunConfig
from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.errors import DataError
from aenerf_ns.files.given_paths import cannot_be_created, require_new


@dataclass
class ExportFrames:
    """Render frames and depths from the corrected poses at chosen times, and write them with their times and their
    cameras as export-cameras does, in the world and the units of the recording."""

    load_config: RunConfig
    output: Path
    """Folder to create."""
    rate: float | None = None
    """Frames a second of the recording; 10 by default."""
    times: tuple[float, ...] = ()
    """Times of the frames in seconds, on the clock of the events, in place of a rate."""
    num_points: int = 20_000
    """The most points of the scene to write."""

    def main(self) -> None:
        """Load the run, render and write."""
        require_new(self.output)
        if self.times and self.rate is not None:
            raise DataError("aenerf export-frames", "--rate and --times are given", "leave out one of the two")
        # Imported lazily, because these imports take seconds.
        from aenerf_ns.export.frames import export_frames
        from aenerf_ns.export.times import times_at_rate, times_of_seconds

        _, pipeline, _ = open_run(self.load_config, test_mode="inference")
        if self.times:
            times = times_of_seconds(pipeline, self.times)
        else:
            times = times_at_rate(pipeline, 10.0 if self.rate is None else self.rate)
        try:
            export_frames(pipeline, self.output, times, self.num_points)
        except OSError as error:
            raise cannot_be_created(self.output, error) from None
        CONSOLE.print(f"{self.output}: {len(times)} frames with depths, times and cameras.", soft_wrap=True)
