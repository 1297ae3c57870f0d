"""The format of a dataset, as subcommands of the commands that read a dataset."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from copy import copy
from dataclasses import field, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, get_type_hints

import tyro

from aenerf_ns.cli.arguments import Automatic
from aenerf_ns.dataparsers.formats import FORMATS, recognize
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.options import EventDataParserConfig


def _format_options(config: EventDataParserConfig) -> Any:
    """Return the config without the options that place a recording in a scene.

    Commands that read a dataset keep the world of the recording.
    """
    kind = type(config)
    hints, suppress = get_type_hints(kind), cast(Any, tyro.conf.Suppress)
    hidden = [
        (option.name, suppress[hints[option.name]], field(default=getattr(config, option.name)))
        for option in fields(EventDataParserConfig)
        # The longest gap between poses belongs to the recording, not to the scene.
        if option.name != "max_pose_gap_ns"
    ]
    options = make_dataclass(kind.__name__, hidden, bases=(kind,), namespace={"__doc__": kind.__doc__})
    return options(**{option.name: getattr(config, option.name) for option in fields(config)})


if TYPE_CHECKING:
    DatasetFormat = Automatic | EventDataParserConfig
else:
    DatasetFormat = tyro.conf.OmitArgPrefixes[
        tyro.extras.subcommand_type_from_defaults(
            {"auto": Automatic(), **{name: _format_options(config) for name, config in FORMATS.items()}},
            descriptions={"auto": "recognize the format from the files of the dataset"},
            prefix_names=False,
        )
    ]


def training_command(
    data: Path,
    dataset_format: DatasetFormat | None = None,
    options: Mapping[str, object] | None = None,
    method: str = "aenerf",
) -> str:
    """Return the whole command that trains on a dataset.

    Args:
        data: the dataset.
        dataset_format: its format with its options, where it is not recognised or its options are not the default.
        options: options of the method, by name.
        method: its name.
    """
    words = ["ns-train", method]
    for name, value in (options or {}).items():
        words += [f"--{name}", str(value)]
    if isinstance(dataset_format, EventDataParserConfig):
        name, default = next(item for item in FORMATS.items() if isinstance(dataset_format, type(item[1])))
        words.append(name)
        for option in fields(default):
            value = getattr(dataset_format, option.name)
            if option.name != "data" and value != getattr(default, option.name):
                words += [f"--{option.name.replace('_', '-')}", str(value)]
    return shlex.join([*words, "--data", str(data)])


def open_dataset(data: Path, dataset_format: DatasetFormat) -> EventDataParser:
    """Return the parser of a dataset.

    Raises:
        DataError: the format is not recognised.
    """
    guessed = None
    if isinstance(dataset_format, Automatic):
        guessed = recognize(data)
        dataset_format = FORMATS[guessed]
    config = copy(dataset_format)
    config.data = data
    parser = config.setup()
    parser.guessed_format = guessed
    return parser
