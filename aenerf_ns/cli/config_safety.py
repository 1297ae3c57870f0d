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
# What Python 3.11.0 to 3.11.3 writes of a member of an enumeration: the class and the name follow.
_GETATTR = f"{_YAML}python/object/apply:builtins.getattr"
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
    text = read_yaml_text(config, _MAX_BYTES)
    try:
        events = list(yaml.parse(text, Loader=yaml.Loader))
    except YAML_ERRORS as error:
        raise DataError(config, f"it cannot be read ({error})", _REMEDY) from None
    tagged = [(index, event) for index, event in enumerate(events) if getattr(event, "tag", None) is not None]
    for index, event in tagged:
        kind, name = _split(event)
        if event.tag in _PLAIN or _is_known(kind, name):
            continue
        if event.tag == _GETATTR and _is_member(events[: index + 4]):
            continue
        line = event.start_mark.line + 1
        if kind in ("python/object", "python/name") and name.startswith("aenerf_ns.") and _find(name) is None:
            problem = f"line {line} names {name}, which this version does not have"
            raise DataError(config, problem, "open it with the version that trained it, or train again")
        raise DataError(config, f"line {line} names {kind}:{name}, and opening the file could run it", _REMEDY)
    if not tagged or _split(tagged[0][1])[0] != "python/object":
        raise DataError(config, "not the config.yml of a run", _REMEDY)


def _is_known(kind: str, name: str) -> bool:
    """Tell whether a tag makes nothing but an object of a known class."""
    if (kind == "python/object/apply" and name in _CALLED) or (kind == "python/name" and name in _FUNCTIONS):
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


def _is_member(events: list[yaml.Event]) -> bool:
    """Tell whether the last three events are a known class of enumerations, the name of a member, and an end."""
    owner, member, end = events[-3:]
    if isinstance(owner, yaml.AliasEvent):
        owner = next(event for event in events if getattr(event, "anchor", None) == owner.anchor)
    kind, name = _split(owner)
    found = _find(name)
    return (
        kind == "python/name"
        and isinstance(found, enum.EnumMeta)
        and isinstance(member, yaml.ScalarEvent)
        and member.value in found.__members__
        and isinstance(end, yaml.SequenceEndEvent)
    )


def _split(event: yaml.Event) -> tuple[str, str]:
    """Return the kind and the name that an event's tag states."""
    kind, _, name = (getattr(event, "tag", None) or "").removeprefix(_YAML).partition(":")
    return kind, name


def _find(name: str) -> Any:
    """Import what a dotted name stands for, or return None where no known package has it."""
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute, None) if name.startswith(_PACKAGES) else None
    except ImportError:
        return None
