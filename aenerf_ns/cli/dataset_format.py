"""The format of a dataset, as subcommands of the commands that read a dataset."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, get_type_hints

import tyro

from aenerf_ns.dataparsers.formats import FORMATS, recognise
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.options import EventDataParserConfig


@dataclass
class Automatic:
    """Recognise the format from the files of the dataset."""


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
            descriptions={
                "auto": "recognise the format from the files of the dataset",
                **{name: (type(config).__doc__ or "").splitlines()[0] for name, config in FORMATS.items()},
            },
            prefix_names=False,
        )
    ]


def open_dataset(data: Path, dataset_format: DatasetFormat) -> EventDataParser:
    """Return the parser of a dataset.

    Raises:
        DataError: the format is not recognised.
    """
    config = copy(FORMATS[recognise(data)] if isinstance(dataset_format, Automatic) else dataset_format)
    config.data = data
    return config.setup()
