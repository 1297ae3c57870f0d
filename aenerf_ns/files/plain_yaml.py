"""YAML that holds nothing but lists, dictionaries, texts and numbers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from aenerf_ns.errors import DataError
from aenerf_ns.files.limits import read_text

# Calibrations have 1 kB a camera. PyYAML reads 0.1 MB in a second.
_MAX_BYTES = 1 << 17

# PyYAML takes time at every token for each bracket that is open.
_MAX_BRACKETS = 2000

YAML_ERRORS = (yaml.YAMLError, ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)
"""What PyYAML raises for a malformed file. A value that a tag does not fit ends in Python's own errors."""


class _Loader(yaml.SafeLoader):
    """Refuse aliases. Few of them make a value of any size, or one that holds itself."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it has aliases, which the programs that write such files do not use")
        return super().compose_node(parent, index)


# YAML 1.1 takes 1e-05, as Python prints it, for a text.
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(r"[-+]?\d+[eE][-+]?\d+$"), list("-+0123456789"))
_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _Loader.construct_yaml_map)


def read_yaml_text(path: Path, max_bytes: int) -> str:
    """Return the text of a YAML file.

    Raises:
        DataError: the file is missing, too large, or not text, or it has more brackets than such a file can have.
    """
    text = read_text(path, max_bytes)
    brackets = text.count("[") + text.count("{")
    if brackets > _MAX_BRACKETS:
        raise DataError(path, f"it has {brackets:,} opening brackets", f"such a file has at most {_MAX_BRACKETS:,}")
    return text


def read_plain_yaml(path: Path, max_bytes: int = _MAX_BYTES) -> Any:
    """Return the value of a YAML file.

    Raises:
        DataError: the file is missing, too large, or not valid YAML, or it has aliases.
    """
    # OpenCV's first line is no YAML, and rostopic's last line ends a message.
    text = read_yaml_text(path, max_bytes).removeprefix("%YAML:1.0").rstrip().removesuffix("\n---")
    try:
        return yaml.load(text, _Loader)
    except YAML_ERRORS as error:
        raise DataError(path, f"not valid YAML ({' '.join(str(error).split())})", "correct that line") from None
