"""The dataset that a command reads, its format, and the command that trains on it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import require_dataset

if TYPE_CHECKING:
    from aenerf_ns.recording.dataparser import EventDataParser
    from aenerf_ns.recording.options import EventDataParserConfig

    FormatName = str
else:
    # From the package's metadata, because the formats themselves take seconds to import.
    _POINTS = entry_points(group="nerfstudio.dataparser_configs")
    _NAMES = [point.name for point in _POINTS if point.value.startswith("aenerf_ns.") and point.name != "event-data"]
    FormatName = Literal[("auto", *_NAMES)]


@dataclass
class DatasetCommand:
    """A command that reads a dataset of any format."""

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """The dataset. --data DATA works too."""
    format: FormatName = field(default="auto", kw_only=True)
    """Format of the dataset. By default it is recognized from the names of the files."""
    format_options: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE ...")] = field(default=(), kw_only=True)
    """Options of the format (docs/options.md), such as width=346 height=260."""

    def open_dataset(self) -> EventDataParser:
        """Make the parser of the dataset, which reads nothing yet.

        Raises:
            DataError: there is no such dataset, its format is not recognized or lacks an option, or a value is wrong.
        """
        require_dataset(self.data)
        from aenerf_ns.dataparsers.formats import FORMATS, recognize

        guessed = recognize(self.data) if self.format == "auto" else None
        name = guessed or self.format
        config = _with_options(FORMATS[name], name, self.format_options)
        config.data = self.data
        parser = config.setup()
        parser.guessed_format = guessed
        return parser


def _with_options(config: EventDataParserConfig, name: str, options: Sequence[str]) -> EventDataParserConfig:
    """Copy the configuration of a format, with options set by ``key=value``."""
    from aenerf_ns.recording.options import EventDataParserConfig

    # Commands keep the world of the recording, so options that place it in a scene have no effect. The longest gap
    # between poses belongs to the recording.
    without_effect = {option.name for option in fields(EventDataParserConfig)} - {"max_pose_gap_ns"}
    known = [option.name for option in fields(config) if option.name not in without_effect]
    config = copy(config)
    for option in options:
        key, equals, value = option.partition("=")
        if not equals or key.replace("-", "_") not in known:
            remedy = f"write KEY=VALUE with one of {', '.join(known)}"
            raise DataError(f"--format-options {option}", f"not an option of {name}", remedy)
        try:
            # As ns-train parses it.
            config = tyro.cli(
                type(config),
                default=config,
                args=[f"--{key}={value}"],
                config=(tyro.conf.FlagConversionOff,),
                console_outputs=False,
            )
        except SystemExit:
            remedy = f"see {name} in docs/options.md for what {key} may be"
            raise DataError(f"--format-options {option}", f"{value!r} is not a value of {key}", remedy) from None
    return config


def training_command(
    data: Path, method: str = "aenerf", options: Mapping[str, object] | None = None, format_words: Sequence[str] = ()
) -> str:
    """Write the whole command that trains on a dataset.

    Args:
        data: the dataset.
        method: name of the method.
        options: options of the method, by name.
        format_words: name and options of the dataset's format, where it is not recognized or has options.
    """
    words = ["ns-train", method]
    for name, value in (options or {}).items():
        words += [f"--{name}", str(value)]
    return shlex.join([*words, *format_words, "--data", str(data)])
