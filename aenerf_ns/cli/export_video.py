"""``aenerf export-video``: recorded and rendered events, the rendering and the image beside each other, as a video."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.cli.export_arguments import ExportVideoArguments
from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.cli.video_file import new_video
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import cannot_be_created


@dataclass
class ExportVideo(ExportVideoArguments):
    __doc__ = ExportVideoArguments.__doc__

    def main(self) -> None:
        """Load the run, render and write the video."""
        self.judge()
        # Imported lazily, because these imports take seconds.
        from aenerf_ns.export.times import times_at_rate
        from aenerf_ns.export.video import side_by_side

        _, run, _ = open_run(self.load_config, test_mode="inference")
        run.scene.event_file.require()
        times = times_at_rate(run.scene.window, self.rate)
        if len(times) < 2:
            raise DataError("aenerf export-video", f"a rate of {self.rate} gives no two frames", "give a higher --rate")
        pictures = side_by_side(run, times)
        first = next(pictures)
        try:
            self.output.parent.mkdir(parents=True, exist_ok=True)
            with closing(new_video(self.output, first.shape[1], first.shape[0], self.frame_rate)) as video:
                video.send(first.tobytes())
                for picture in pictures:
                    video.send(picture.tobytes())
        except OSError as error:
            raise cannot_be_created(self.output, error) from None
        CONSOLE.print(f"{self.output}: {len(times) - 1} frames.", soft_wrap=True)
