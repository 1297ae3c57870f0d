"""``aenerf check``: look a dataset over."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from aenerf_ns.checking.contrast import WarpedEvents
from aenerf_ns.checking.picture import warped_picture
from aenerf_ns.checking.report import Report
from aenerf_ns.cli.arguments import Automatic, CheckArguments
from aenerf_ns.cli.dataset_format import DatasetFormat, open_dataset, training_command
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import created
from aenerf_ns.recording.scene import SCENE_KEY


@dataclass
class Check(CheckArguments):
    __doc__ = CheckArguments.__doc__

    format: DatasetFormat = field(default_factory=Automatic)

    def main(self) -> None:
        """Print what is found, and end the process with a status other than 0 unless all is well."""
        try:
            self.judge()
            problems = self._problems()
        except DataError as error:
            print(f"Error: {error}", file=sys.stderr)
            sys.exit(2)
        if problems:
            _print(f"\n{len(problems)} {'problem' if len(problems) == 1 else 'problems'}:")
            for problem in problems:
                _print(f"  - {problem}")
            sys.exit(1)
        _print("\nNo problems found.")

    def _problems(self) -> list[str]:
        """Print the figures, write the picture and return the problems."""
        parser = open_dataset(self.data, self.format)
        # Training and evaluation will ask for all three splits.
        outputs = [parser.get_dataparser_outputs(split) for split in ("train", "val", "test")]
        report = Report(parser.recording, outputs[0].metadata[SCENE_KEY].window, outputs[0].dataparser_scale, _print)
        command = training_command(self.data, self.format, report.planes)
        remark = " (near and far plane for a camera that stays that close)" if report.planes else ""
        _print(f"Train with{remark}: {command}")
        if self.picture is not None:
            if report.warped is None:
                _print(f"{self.picture}: not written, because too few events have a pose")
            else:
                _write_picture(self.picture, report.warped)
        return report.problems


def _print(line: str) -> None:
    CONSOLE.print(line, highlight=False, markup=False, soft_wrap=True)


def _write_picture(path: Path, warped: WarpedEvents) -> None:
    with created(path, "--picture"):
        Image.fromarray(warped_picture(warped)).save(path)
    _print(f"{path}: events as they came, and warped")
