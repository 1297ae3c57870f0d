"""``aenerf check``: look at a dataset before training on it."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from aenerf_ns.cli.console import say
from aenerf_ns.cli.dataset import DatasetCommand, training_command
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import creating, require_writable

if TYPE_CHECKING:
    from aenerf_ns.checking.result import CheckResult
    from aenerf_ns.recording.dataparser import EventDataParser

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass
class Check(DatasetCommand):
    """Check the events of a dataset, its poses if it has any, and whether the two fit each other. Exit status 0 if all
    is well, 1 if there are problems, 2 if the dataset cannot be read."""

    picture: Path | None = None
    """PNG file to write: events as they came, and warped to one view by the poses."""

    placing_options: ClassVar[tuple[str, ...]] = (
        "orientation_method", "center_method", "scale_factor", "auto_scale_poses", "start_time_ns", "end_time_ns",
    )  # fmt: skip
    error_status: ClassVar[int] = 2
    """Exit status for a dataset that cannot be read."""

    def main(self) -> None:
        """Print what is found, write the picture, and end the process with status 1 if there are problems."""
        if self.picture is not None:
            if self.picture.suffix.lower() not in _IMAGE_SUFFIXES:
                raise DataError(self.picture, "not the name of a picture", "end the --picture with .png")
            require_writable(self.picture, "--picture")
        parser = self.open_dataset()
        from PIL import Image

        from aenerf_ns.checking.report import check
        from aenerf_ns.recording.recording import Recording
        from aenerf_ns.recording.scene import SCENE_KEY

        capture, frames = parser.read_frames()
        if isinstance(capture, Recording):
            # Training and evaluation will ask for all three splits.
            outputs = [parser.get_dataparser_outputs(split) for split in ("train", "val", "test")]
            result = check(capture, frames, outputs[0].metadata[SCENE_KEY].window, outputs[0].dataparser_scale)
        else:
            result = check(capture, frames)
        for figure in result.figures:
            say(figure)
        if isinstance(capture, Recording):
            self._say_training_command(parser, result)
        else:
            self._say_command_that_finds_poses(parser, result)
        if self.picture is not None and result.warped is not None:
            with creating(self.picture, "--picture") as file:
                Image.fromarray(result.warped.picture()).save(file)
            say(f"{self.picture}: events as they came, and warped")
        elif self.picture is not None:
            say(f"{self.picture}: not written, because too few events have a pose")
        if result.problems:
            say(f"\n{len(result.problems)} {'problem' if len(result.problems) == 1 else 'problems'}:")
            for problem in result.problems:
                say(f"  - {problem}")
            sys.exit(1)
        say("\nNo problems found.")

    def _say_training_command(self, parser: EventDataParser, result: CheckResult) -> None:
        format_words: list[str] = []
        if self.format != "auto" or self.format_options or result.sensor_options:
            format_words = [parser.guessed_format or self.format]
            for option in self.format_options:
                format_words += f"--{option}".split("=", 1)
            for name, value in result.sensor_options.items():
                format_words += [f"--{name}", value]
        command = training_command(self.data, options=result.planes, format_words=format_words)
        remark = " (near and far plane for a camera that stays that close)" if result.planes else ""
        say(f"Train with{remark}: {command}")

    def _say_command_that_finds_poses(self, parser: EventDataParser, result: CheckResult) -> None:
        words = ["aenerf", "convert", str(self.data), "--output", "FOLDER", "--poses", "events"]
        if self.format != "auto":
            words += ["--format", self.format]
        for name in ("start_time_ns", "end_time_ns"):
            if (time := getattr(parser.config, name)) is not None:
                words += [f"--{name.replace('_', '-')}", str(time)]
        # The command keeps the world of the recording, and refuses options that place it in a scene.
        options = [
            one for one in self.format_options if one.split("=")[0].replace("-", "_") not in self.placing_options
        ]
        options += map("=".join, result.sensor_options.items())
        if options:
            words += ["--format-options", *options]
        say(f"There are no poses at {parser.poses_path()}. Find them with: {shlex.join(words)}")
