"""``aenerf export-frames``: rendered frames and depths along the trajectory of a trained run."""

from __future__ import annotations

from dataclasses import dataclass

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.cli.export_arguments import ExportFramesArguments
from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.files.output_paths import cannot_be_created


@dataclass
class ExportFrames(ExportFramesArguments):
    __doc__ = ExportFramesArguments.__doc__

    def main(self) -> None:
        """Load the run, render and write."""
        self.judge()
        # Imported lazily, because these imports take seconds.
        from aenerf_ns.export.frames import export_frames
        from aenerf_ns.export.times import times_at_rate, times_of_seconds

        _, run, _ = open_run(self.load_config, test_mode="inference")
        if self.times:
            times = times_of_seconds(run.scene.window, self.times)
        else:
            times = times_at_rate(run.scene.window, 10.0 if self.rate is None else self.rate)
        try:
            export_frames(run, self.output, times, self.num_points)
        except OSError as error:
            raise cannot_be_created(self.output, error) from None
        CONSOLE.print(f"{self.output}: {len(times)} frames with depths, times and cameras.", soft_wrap=True)
