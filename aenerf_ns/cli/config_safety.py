"""Check of the names in the ``config.yml`` of a trained run, before it is opened.

The framework opens the file with a loader of YAML that makes any object and calls any function that the file names.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
from pathlib import Path
from typing import Any

import yaml

from aenerf_ns.errors import DataError
from aenerf_ns.files.plain_yaml import YAML_ERRORS, read_yaml_text

_YAML = "tag:yaml.org,2002:"
_PLAIN = {f"{_YAML}{name}" for name in ("null", "bool", "int", "float", "str", "seq", "map")} | {
    f"{_YAML}python/{name}" for name in ("tuple", "list", "dict")
}
# Packages whose classes a configuration may name.
_PACKAGES = ("nerfstudio.", "torch.optim.", "aenerf_ns.")
# What else the framework's configurations name.
_CALLED = {f"pathlib.{name}" for name in ("PosixPath", "PurePosixPath", "WindowsPath", "PureWindowsPath", "Path")}
_FUNCTIONS = {"nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate"}
_REMEDY = "give the config.yml of a trained run, and only one that you trust"
# A configuration has some kB. PyYAML reads 0.1 MB in a second.
_MAX_BYTES = 1 << 18


def require_known_names(config: Path) -> None:
    """Raise a DataError unless all that a config.yml names is of the framework, torch's optimizers or this package.

    A name must be of a class. Nothing is called but paths and enumerations. So no function of these packages runs
    because the file says so.
    """
    try:
        events = yaml.parse(read_yaml_text(config, _MAX_BYTES), Loader=yaml.Loader)
        tags = [(event.tag, event.start_mark.line + 1) for event in events if getattr(event, "tag", None) is not None]
    except DataError:
        raise
    except YAML_ERRORS as error:
        raise DataError(config, f"it cannot be read ({error})", _REMEDY) from None
    for tag, line in tags:
        kind, _, name = tag.removeprefix(_YAML).partition(":")
        if tag in _PLAIN or _is_known(kind, name):
            continue
        if kind in ("python/object", "python/name") and name.startswith("aenerf_ns.") and _find(name) is None:
            problem = f"line {line} names {name}, which this version does not have"
            raise DataError(config, problem, "open it with the version that trained it (0.1), or train again")
        raise DataError(config, f"line {line} names {kind}:{name}, and opening the file could run it", _REMEDY)
    if not tags or not tags[0][0].startswith(f"{_YAML}python/object:"):
        raise DataError(config, "not the config.yml of a run", _REMEDY)


def _is_known(kind: str, name: str) -> bool:
    """Tell whether a tag makes nothing but an object of a known class."""
    if (kind == "python/object/apply" and name in _CALLED) or (kind == "python/name" and name in _FUNCTIONS):
        return True
    found = _find(name) if name.startswith(_PACKAGES) else None
    # A module of a known package may have imported a class of another one.
    if not isinstance(found, type) or not f"{found.__module__}.".startswith(_PACKAGES):
        return False
    return (
        kind == "python/name"
        or (kind == "python/object" and dataclasses.is_dataclass(found))
        or (kind == "python/object/apply" and issubclass(found, enum.Enum))
    )


def _find(name: str) -> Any:
    """Import what a dotted name of a known package stands for, or return None."""
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute, None)
    except ImportError:
        return None
