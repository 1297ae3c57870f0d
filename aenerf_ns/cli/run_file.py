"""Check of the names in the ``config.yml`` of a trained run.

The file is opened by a loader of YAML that makes any object and calls any function that the file names. So it is read
as text before it is opened.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
from pathlib import Path
from typing import Any

import yaml

from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import require_run
from aenerf_ns.files.plain_yaml import YAML_ERRORS, read_yaml_text

_YAML = "tag:yaml.org,2002:"
_PLAIN = {
    f"{_YAML}{name}"
    for name in ("null", "bool", "int", "float", "str", "seq", "map", "python/tuple", "python/list", "python/dict")
}
# Whose classes a configuration is made of.
_PACKAGES = ("nerfstudio.", "torch.optim.", "aenerf_ns.")
# The framework's configurations name these classes and functions, too.
_PATHS = {f"pathlib.{name}" for name in ("PosixPath", "PurePosixPath", "WindowsPath", "PureWindowsPath", "Path")}
_FUNCTIONS = {"nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate"}
_REMEDY = "give the config.yml of a trained run, and only one that you trust"
# A configuration has some kB. PyYAML reads 0.1 MB in a second.
_MAX_BYTES = 1 << 18


def require_plausible(run: Path) -> None:
    """Raise a DataError unless a file, or that in a folder, may be the config.yml of a run, without importing anything
    that it names."""
    config = require_run(run)
    tags = _tags(config)
    for tag, line in tags:
        if not _is_plausible(tag):
            raise _foreign(config, tag, line)
    _require_run(config, tags)


def require_known_tags(config: Path) -> None:
    """Raise a DataError unless all that a config.yml names is of the framework, torch's optimizers or this package.

    A name must be of a class. Nothing is called but paths and enumerations. So no function of these packages runs
    because the file says so.
    """
    tags = _tags(config)
    for tag, line in tags:
        if not _is_known(tag):
            kind, _, name = tag.removeprefix(_YAML).partition(":")
            if kind in ("python/object", "python/name") and name.startswith("aenerf_ns.") and _find(name) is None:
                raise DataError(
                    config, f"line {line} names {name}, not of this version", "open it with the version that trained it"
                )
            raise _foreign(config, tag, line)
    _require_run(config, tags)


def _tags(config: Path) -> list[tuple[str, int]]:
    """Return the tags of a configuration with their lines."""
    try:
        tags = [
            (event.tag, event.start_mark.line + 1)
            for event in yaml.parse(read_yaml_text(config, _MAX_BYTES), Loader=yaml.Loader)
            if getattr(event, "tag", None) is not None
        ]
    except YAML_ERRORS as error:
        if isinstance(error, DataError):
            raise
        raise DataError(config, f"it cannot be read ({error})", _REMEDY) from None
    return tags


def _require_run(config: Path, tags: list[tuple[str, int]]) -> None:
    if not tags or not tags[0][0].startswith(f"{_YAML}python/object:"):
        raise DataError(config, "it is no configuration of a run", _REMEDY)


def _foreign(config: Path, tag: str, line: int) -> DataError:
    return DataError(config, f"line {line} names {tag.removeprefix(_YAML)}, and opening the file could run it", _REMEDY)


def _is_plausible(tag: str) -> bool:
    """Return whether a tag is of plain values, or names something of a known package."""
    kind, _, name = tag.removeprefix(_YAML).partition(":")
    return tag in _PLAIN or (kind == "python/object/apply" and name in _PATHS) or name.startswith(_PACKAGES)


def _is_known(tag: str) -> bool:
    """Return whether a tag makes nothing but plain values and objects of known classes."""
    if tag in _PLAIN:
        return True
    kind, _, name = tag.removeprefix(_YAML).partition(":")
    if kind == "python/object/apply" and name in _PATHS:
        return True
    if not name.startswith(_PACKAGES):
        return False
    if kind == "python/name" and name in _FUNCTIONS:
        return True
    found = _find(name)
    # A module of a known package may have imported a class of another one.
    if not isinstance(found, type) or not f"{found.__module__}.".startswith(_PACKAGES):
        return False
    return (
        kind == "python/name"
        or (kind == "python/object" and dataclasses.is_dataclass(found))
        or (kind == "python/object/apply" and issubclass(found, enum.Enum))
    )


def _find(name: str) -> Any:
    """Return what a dotted name of a known package stands for, or None."""
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute, None)
    except ImportError:
        return None
