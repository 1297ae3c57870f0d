"""All dataset formats by name, and which one a folder is in."""

from __future__ import annotations

from pathlib import Path

from aenerf_ns.dataparsers.ecd import EcdDataParserConfig
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.dataparsers.recording import EventDataParserConfig
from aenerf_ns.errors import DataError

# The names that the dataparsers are registered by.
FORMATS: dict[str, EventDataParserConfig] = {
    "aenerf-data": NativeDataParserConfig(),
    "ecd-data": EcdDataParserConfig(),
}

_SIGNS = {"aenerf-data": "transforms.json", "ecd-data": "events.txt"}


def recognise(data: Path) -> str:
    """The name of the format that a dataset is in.

    Raises:
        DataError: it is in none.
    """
    if not data.exists():
        raise DataError(data, "there is no such folder", "check the path of the dataset")
    for name, file in _SIGNS.items():
        if (data / file).is_file():
            return name
    raise DataError(data, f"none of {', '.join(_SIGNS.values())} is there", f"name the format: {', '.join(FORMATS)}")
