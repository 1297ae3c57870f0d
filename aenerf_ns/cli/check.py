"""``aenerf check``: look at a dataset before training on it."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.cli.dataset import DatasetCommand, training_command
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import creating, require_writable

if TYPE_CHECKING:
    from aenerf_ns.checking.contrast import WarpedEvents

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass
class Check(DatasetCommand):
    """Check the events of a dataset, its poses, and whether the two fit each other. Exit status 0 if all is well, 1
    if there are problems, 2 if the dataset cannot be read."""

    picture: Path | None = None
    """PNG file to write: events as they came, and warped to one view by the poses."""

    error_status: ClassVar[int] = 2
    """Exit status for a dataset that cannot be read."""

    def main(self) -> None:
        """Print what is found, and end the process with status 1 if there are problems."""
        if self.picture is not None:
            if self.picture.suffix.lower() not in _IMAGE_SUFFIXES:
                raise DataError(self.picture, "not the name of a picture", "end the --picture with .png")
            require_writable(self.picture, "--picture")
        problems = self._find_problems()
        if problems:
            _print(f"\n{len(problems)} {'problem' if len(problems) == 1 else 'problems'}:")
            for problem in problems:
                _print(f"  - {problem}")
            sys.exit(1)
        _print("\nNo problems found.")

    def _find_problems(self) -> list[str]:
        """Print the figures, write the picture and return the problems."""
        parser = self.open_dataset()
        from aenerf_ns.checking.report import check
        from aenerf_ns.recording.scene import SCENE_KEY

        # Training and evaluation will ask for all three splits.
        outputs = [parser.get_dataparser_outputs(split) for split in ("train", "val", "test")]
        result = check(parser.recording, outputs[0].metadata[SCENE_KEY].window, outputs[0].dataparser_scale)
        for figure in result.figures:
            _print(figure)
        format_words: list[str] = []
        if self.format != "auto" or self.format_options:
            format_words = [parser.guessed_format or self.format]
            for option in self.format_options:
                format_words += f"--{option}".split("=", 1)
        command = training_command(self.data, options=result.planes, format_words=format_words)
        remark = " (near and far plane for a camera that stays that close)" if result.planes else ""
        _print(f"Train with{remark}: {command}")
        if self.picture is not None:
            if result.warped is None:
                _print(f"{self.picture}: not written, because too few events have a pose")
            else:
                _write_picture(self.picture, result.warped)
        return result.problems


def _print(line: str) -> None:
    CONSOLE.print(line, highlight=False, markup=False, soft_wrap=True)


def _write_picture(path: Path, warped: WarpedEvents) -> None:
    from PIL import Image

    with creating(path, "--picture"):
        Image.fromarray(warped.picture()).save(path)
    _print(f"{path}: events as they came, and warped")
